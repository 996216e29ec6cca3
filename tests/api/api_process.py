"""The API as a process of its own, as it is deployed: takes a database address, listens on a free port, says where."""

from __future__ import annotations

import os
import sys
import threading

from services.api import create_app, create_server
from services.observability.logging import configure_logging
from services.settings import Settings
from services.store.sql import SqlStore


def main() -> None:
    os.environ["VIPE_PORT"] = "0"
    os.environ.update({f"VIPE_{name.upper()}": value for name, value in (arg.split("=", 1) for arg in sys.argv[2:])})
    settings = Settings(database_url=sys.argv[1])
    configure_logging(settings.log_level, settings.log_format)
    store = SqlStore(settings.database_url)
    server = create_server(create_app(store, settings), settings)

    def tell() -> None:
        while not server.started:
            stopped.wait(0.01)
        sys.stdout.write(f"{server.url}\n")
        sys.stdout.flush()

    stopped = threading.Event()
    threading.Thread(target=tell, daemon=True).start()
    server.run()
    store.close()


if __name__ == "__main__":
    main()
