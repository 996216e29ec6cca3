"""schemathesis over a running service: `python tests/api/openapi_fuzz.py [--examples N] [--seed N]`.

Every operation of the OpenAPI document gets generated requests, right and wrong ones, with a key and without. No answer
may be a server error, have a status or a media type that the document does not name, or a body that its schema does not
accept; no invalid request may be accepted. Prints what fails and exits with 1.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from api_service import running

KEY = "fuzz"
# The service is asked for keys on loopback too, and not how often the fuzzer may ask.
SETTINGS = (
    f"api_key={KEY}",
    "rate_limit_per_s=100000",
    "rate_limit_burst=1000000",
    "max_wrong_keys=1000000",
    "log_level=ERROR",
)
_CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
    "missing_required_header",
    "unsupported_method",
    "allow_header_conformance",
    "use_after_free",
)


def fuzz(
    url: str, key: str | None, *, examples: int, seed: int = 0, phases: str = "examples,coverage,fuzzing,stateful"
) -> subprocess.CompletedProcess[str]:
    """Run schemathesis in a process of its own; its return code is 0 if nothing was found."""
    options = {
        "--checks": ",".join(_CHECKS if key is None else (*_CHECKS, "ignored_auth")),
        "--phases": phases,
        "--max-examples": str(examples),
        "--seed": str(seed),
        "--suppress-health-check": "all",
        "--request-timeout": "60",
        "--header": "Accept: application/json",  # a stream would last as long as its job
        "--warnings": "off",
    }
    command = [str(Path(sys.executable).with_name("schemathesis")), "run", f"{url}/openapi.json"]
    command += [part for option in options.items() for part in option]
    command += ["--generation-deterministic", "--continue-on-failure", "--no-color"]
    if key is not None:
        command += ["--header", f"Authorization: Bearer {key}"]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=tempfile.gettempdir())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=300, help="per operation and phase")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as folder, running(f"sqlite:///{folder}/fuzz.db", *SETTINGS) as service:
        for key in (KEY, None):
            done = fuzz(service.url, key, examples=arguments.examples, seed=arguments.seed)
            sys.stdout.write(done.stdout + done.stderr)
            failed |= done.returncode != 0
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
