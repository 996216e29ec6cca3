"""Worker slots as Ray actors: on a private Ray of this machine, or on a cluster.

Ray only starts, reaches and kills processes. It restarts nothing (`max_restarts=0`, `max_task_retries=0`): a silent
retry would run a video that kills its worker again without telling whom to blame.

A private Ray is bound to this process by the kernel (`PR_SET_PDEATHSIG`): when the process dies, even by SIGKILL, its
raylet and workers die within seconds. The kernel ties this to the *thread* that started them, so `RayExecutor.start`
must be called from a thread that lives as long as the executor.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import math
import os
import secrets
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from services.agent.config import AgentConfig
from services.agent.executor import Died, SlotHandle
from services.agent.gpus import GpuShares, SlotPlan, gpu_memory_bytes, plan_slots
from services.agent.messages import Failed, Reply, SlotProgress, Task
from services.agent.ray_health import RayGate, RayGone, all_alive, answers, end_processes, head_processes
from services.agent.slot import Slot, SlotConfig
from services.observability.logging import configure_logging
from vipe_core.errors import ConfigError, EngineError

logger = logging.getLogger(__name__)

_OBJECT_STORE_BYTES = 100 << 20  # Results are a few kilobytes; frames never travel through Ray.
_SESSION_PATH_CHARS = 66  # "/session_<date>_<time>_<pid>/sockets/plasma_store" and what Ray appends
_MAX_SOCKET_PATH = 107
_PROGRESS_INTERVAL_S = 0.5
_KILL_PATIENCE_S = 2.0
_NAMESPACE = "vipe"
_STEP_S = 0.5  # No call into Ray takes longer, so that Ray can be replaced.
_LEAVE_TIMEOUT_S = 30.0
_CLUSTER_PATIENCE_S = 10.0
_ASKING_TIMEOUT_S = 120.0
_ASKING_GPUS = 0.01
_GONE = Died("Ray's head is gone", preempted=True)
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

# Read by Ray when it is imported: no call may start another Ray by itself.
_ENVIRONMENT = {"RAY_ENABLE_AUTO_CONNECT": "0"}
# A private Ray reports to nobody. Where its head is gone, its processes, and this one, end after the time that is given
# here: after we have replaced it, and soon enough where this process is gone, too. Its own signal handler would end
# this process three seconds after a SIGTERM, in the middle of an orderly stop.
_PRIVATE_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "120",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


class SlotActor:
    """The actor: a `Slot`, with `progress` and `cancel` answered beside the running task."""

    def __init__(self, config: SlotConfig, log_level: str) -> None:
        faulthandler.enable()  # The stack of a crash goes to the worker's log in Ray's session folder.
        configure_logging(log_level, "text")
        self._slot = Slot(config)

    def identity(self) -> tuple[str, int, str, tuple[str, ...]]:
        """(Ray node id, process id, host, the GPUs that this process was given)."""
        import ray

        gpus = tuple(str(gpu) for gpu in ray.get_gpu_ids())
        return ray.get_runtime_context().get_node_id(), os.getpid(), socket.gethostname(), gpus

    def run(self, task: Task) -> Reply:
        return self._slot.run(task)

    def progress(self) -> SlotProgress:
        return self._slot.progress()

    def cancel(self) -> None:
        self._slot.cancel()


class RaySlot:
    """A `SlotHandle` on a Ray actor."""

    def __init__(self, number: int, executor: RayExecutor, config: AgentConfig, *, private: bool) -> None:
        self._number = number
        self._executor = executor
        self._gate = executor.gate
        self._config = config
        self._private = private
        self._actor: Any = None
        self._pid: int | None = None
        self._node_id: str | None = None
        self._place = ""
        self._task: Any = None
        self._lock = threading.Lock()
        self._progress = SlotProgress()
        self._progress_call: Any = None
        self._progress_asked_s = 0.0

    @property
    def pid(self) -> int | None:
        """The worker's process id on its node; None while there is no process."""
        return self._pid

    @property
    def place(self) -> str:
        return self._place

    def start(self, timeout_s: float) -> Died | None:
        from ray.exceptions import RayError

        deadline = time.monotonic() + timeout_s
        if not self._gate.wait_open(timeout_s):
            return _GONE
        try:
            return self._start(deadline)
        except RayError as error:
            return self._judged(_died(error))
        except RayGone:
            self._actor = None
            return _GONE

    def _start(self, deadline: float) -> Died | None:
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        config = self._config
        options: dict[str, Any] = {}
        if self._node_id is not None and not self._private:
            # Finished artifacts lie on the node of the last process.
            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(self._node_id, soft=True)
        slot_config = SlotConfig(
            config.scratch_dir,
            config.device,
            config.engine,
            config.s3_endpoint_url,
            config.scratch_max_age_s,
            config.inputs,
            config.media,
        )
        level = logging.getLevelName(logging.getLogger().getEffectiveLevel())
        with self._gate.inside():
            self._actor = self._executor.actor_class.options(**options).remote(slot_config, level)
            identity = self._actor.identity.remote()
        while True:
            with self._gate.inside():
                if ray.wait([identity], timeout=_STEP_S)[0]:
                    self._node_id, self._pid, host, gpus = ray.get(identity)
                    break
            if time.monotonic() > deadline:
                return Died("the process was not ready in time")
        # Slots without a GPU of their own are told apart by the scratch folder, too: a host may have several agents.
        slot = f"{host}:{self._config.scratch_dir}/slot-{self._number}"
        self._place = f"{host}/gpu-{','.join(gpus)}" if gpus else slot
        with self._lock:
            self._progress, self._progress_call = SlotProgress(), None
        return None

    def submit(self, task: Task) -> None:
        if self._actor is None or self._task is not None:
            raise RuntimeError("a slot takes one task at a time, and only while its process lives")
        with self._lock:  # What is known is about the task before this one.
            self._progress, self._progress_call = SlotProgress(), None
        try:
            with self._gate.inside():
                self._task = self._actor.run.remote(task)
        except RayGone:
            self._task = None  # `poll` tells.

    def poll(self, timeout_s: float) -> Reply | Died | None:
        import ray
        from ray.exceptions import RayError, RayTaskError

        if self._task is None:
            return _GONE
        try:
            with self._gate.inside():
                ready, _ = ray.wait([self._task], timeout=timeout_s)
                if not ready:
                    return None
                reply: Reply = ray.get(ready[0])
        except RayTaskError as error:
            self._task = None
            first = str(error.cause or error).splitlines()[0]
            return Reply(Failed(EngineError.code, f"a worker's reply was lost: {first}", False, "shard", str(error)))
        except RayError as error:
            self._task = None
            return self._judged(_died(error))
        except RayGone:
            self._task = None
            return _GONE
        self._task = None
        return reply

    def progress(self) -> SlotProgress:
        import ray
        from ray.exceptions import RayError

        with self._lock:
            actor, call = self._actor, self._progress_call
            try:
                with self._gate.inside():
                    if call is not None and ray.wait([call], timeout=0)[0]:
                        self._progress_call = None
                        self._progress = ray.get(call)
                    elif call is not None:
                        return self._progress
                    now = time.monotonic()
                    if actor is not None and now - self._progress_asked_s >= _PROGRESS_INTERVAL_S:
                        self._progress_asked_s = now
                        self._progress_call = actor.progress.remote()
            except (RayError, RayGone):
                self._progress_call = None  # The task itself will tell that the process died.
            return self._progress

    def cancel(self) -> None:
        from ray.exceptions import RayError

        if self._actor is not None:
            with contextlib.suppress(RayError, RayGone), self._gate.inside():
                self._actor.cancel.remote()

    def kill(self) -> None:
        import ray

        actor, pid = self._actor, self._pid
        self._actor = self._pid = self._task = None
        with self._lock:
            self._progress, self._progress_call = SlotProgress(), None
        if actor is None:
            return
        with contextlib.suppress(Exception), self._gate.inside():  # Ray itself may be gone; then so is the actor.
            ray.kill(actor, no_restart=True)
        if self._private and pid is not None:
            _ensure_gone(pid)

    def _judged(self, died: Died) -> Died:
        """A worker that ends together with Ray's head is nobody's fault."""
        return died if died.preempted or self._executor.healthy() else _GONE


class RayExecutor:
    """An `Executor` on Ray.

    Raises:
        ConfigError: The machine has not the GPUs for the slots.
    """

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self._private = config.ray_address is None
        # Asked here and not in `start`, which is tried again and again: too many slots will not fit later either.
        self._plan: SlotPlan | None = None
        self._num_slots = config.slots
        if self._private and config.device == "cuda":
            self._plan_gpus(gpu_memory_bytes(), os.cpu_count())
        self._temp_dir: Path | None = None
        self._head: dict[int, str] = {}
        self._address = ""
        self._shares: GpuShares | None = None if self._plan is None else GpuShares(self._plan)
        self.gate = RayGate()
        self.actor_class: Any = None
        self._slots: list[RaySlot] = []

    def start(self) -> None:
        """Start a private Ray, or join a cluster as its driver.

        Raises:
            ConnectionError: The cluster does not answer.
        """
        self._connect()
        self._slots = [
            RaySlot(number, self, self._config, private=self._private) for number in range(self._num_slots or 1)
        ]

    @property
    def shares(self) -> GpuShares | None:
        return self._shares

    def restart(self) -> None:
        """Leave a Ray that does not answer and start or join again. Raises what `start` raises."""
        self._disconnect()
        self._connect()

    def healthy(self, patience_s: float = _CLUSTER_PATIENCE_S) -> bool:
        """Whether Ray's head is there: its processes, or where it belongs to others, its address.

        Args:
            patience_s: For how long a cluster may not answer.
        """
        if not self.gate.is_open:
            return False
        return all_alive(self._head) if self._private else answers(self._address, patience_s)

    def slots(self) -> list[SlotHandle]:
        return list(self._slots)

    def stop(self) -> None:
        self._disconnect()
        self._slots = []

    def _connect(self) -> None:
        """Start or join Ray; what is half started when that fails is ended."""
        try:
            self._connect_or_raise()
        except BaseException:
            with contextlib.suppress(Exception):
                self._disconnect()
            raise

    def _connect_or_raise(self) -> None:
        started = time.monotonic()
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        if self._private:
            self._start_private()
        else:
            import ray

            ray.init(
                address=self._config.ray_address,
                namespace=_NAMESPACE,
                log_to_driver=False,
                configure_logging=False,
            )
            if self._config.device == "cuda" and self._plan is None:
                self._shares = GpuShares(self._plan_gpus(self._gpus_of_the_cluster()))
        import ray

        self._head = {} if self._temp_dir is None else head_processes(self._temp_dir)
        self._address = ray.get_runtime_context().gcs_address
        self.actor_class = self._new_actor_class()
        self.gate.open()
        logger.info("Ray is ready after %.1f s", time.monotonic() - started)

    def _disconnect(self) -> None:
        import ray

        if self.healthy():
            for slot in self._slots:
                slot.kill()
        if not self.gate.close(_LEAVE_TIMEOUT_S):
            logger.warning("a call into Ray does not return; it is shut down all the same")
        ray.shutdown()
        if self._temp_dir is not None:
            end_processes(self._temp_dir)
            shutil.rmtree(self._temp_dir, ignore_errors=True)

    def _plan_gpus(self, memory_bytes: Sequence[int], cores: int | None = None) -> SlotPlan:
        """Decide how slots share GPUs, and how many there are where nobody says.

        Raises:
            ConfigError: There is no GPU, or not enough of it.
        """
        from vipe_core.pipeline.memory import idle_bytes, usual_bytes  # Slow to import, and of no use without GPUs.
        from vipe_core.pipeline.presets import resolve

        config, preset = self._config, resolve(self._config.gpu_preset)
        if not memory_bytes:
            raise ConfigError("there is no GPU for device 'cuda'; use device 'cpu', or check the driver")
        usual = usual_bytes(preset)
        plan = plan_slots(
            memory_bytes,
            usual_bytes=usual,
            idle_bytes=idle_bytes(preset),
            cores=None if cores is None else cores // config.cpus_per_slot,
            # Of a cluster, some GPUs may be yet to come.
            slots=config.slots if self._private else None,
            per_gpu=config.slots_per_gpu,
        )
        if self._num_slots is None:
            self._num_slots = plan.per_gpu * len(memory_bytes)
        logger.info(
            "%d slots on %d GPUs, %d on each with %.1f GB; a usual video of preset %s takes %.1f GB by plan",
            self._num_slots,
            len(memory_bytes),
            plan.per_gpu,
            plan.bytes_of(1) / 1e9,
            preset.name,
            usual / 1e9,
        )
        self._plan = plan
        return plan

    def _gpus_of_the_cluster(self) -> list[int]:
        """The memory of each GPU of the cluster, asked on its nodes: those of one node are alike.

        Raises:
            ConnectionError: No GPU has joined it yet, or a node does not answer.
        """
        import ray
        from ray.exceptions import RayError
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        nodes = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("GPU", 0) >= 1]
        if not nodes:
            raise ConnectionError("the Ray cluster has no GPU yet; wait for its nodes")
        ask = ray.remote(num_cpus=0, num_gpus=_ASKING_GPUS, max_retries=0)(gpu_memory_bytes)
        asked = [
            ask.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote()
            for node in nodes
        ]
        try:
            answers: list[tuple[int, ...]] = ray.get(asked, timeout=_ASKING_TIMEOUT_S)
        except (RayError, TimeoutError) as error:
            raise ConnectionError(f"a GPU node of the Ray cluster does not say what it has: {error}") from error
        if not all(answers):
            raise ConnectionError("a node of the Ray cluster offers GPUs that CUDA does not find; check its driver")
        return [
            found[0] for node, found in zip(nodes, answers, strict=True) for _ in range(int(node["Resources"]["GPU"]))
        ]

    def _start_private(self) -> None:
        config = self._config
        os.environ.update(_PRIVATE_ENVIRONMENT)  # Before Ray is imported: it reads some of these only then.
        if "RAY_AUTH_MODE" not in os.environ:
            # Whoever reaches Ray's ports runs code as this user: a token that only this process and its children know.
            os.environ["RAY_AUTH_MODE"] = "token"
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        import ray

        self._temp_dir = private_temp_dir(config.scratch_dir.parent)
        slots = self._num_slots or 1
        gpus = 0 if self._plan is None else math.ceil(slots / self._plan.per_gpu)
        logging.getLogger("ray").setLevel(logging.ERROR)  # It warns about every thread that is not the main one.
        with _environment(self._worker_environment()):  # Workers inherit it, which is faster than a runtime_env.
            ray.init(
                address="local",
                num_cpus=slots * config.cpus_per_slot,
                num_gpus=gpus,
                object_store_memory=_OBJECT_STORE_BYTES,
                include_dashboard=False,
                log_to_driver=False,
                configure_logging=False,
                namespace=_NAMESPACE,
                _temp_dir=str(self._temp_dir),
            )

    def _worker_environment(self) -> dict[str, str]:
        """Numeric libraries use the cores that the slot reserved, and do not spin while they wait."""
        threads = str(self._config.cpus_per_slot)
        return {**dict.fromkeys(_THREAD_VARIABLES, threads), "OMP_WAIT_POLICY": "passive"}

    def _new_actor_class(self) -> Any:
        import ray

        config = self._config
        for beside_the_task in (SlotActor.progress, SlotActor.cancel):
            ray.method(concurrency_group="control")(beside_the_task)  # Marks the function.
        return ray.remote(
            num_cpus=config.cpus_per_slot,
            num_gpus=0 if self._plan is None else self._plan.gpus_per_slot,
            max_restarts=0,
            max_task_retries=0,
            concurrency_groups={"control": 2},
            runtime_env=None if self._private else {"env_vars": self._worker_environment()},
        )(SlotActor)


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def private_temp_dir(preferred: Path) -> Path:
    """A new folder for a private Ray, short enough for its sockets; leftovers of dead processes are removed."""
    pid = os.getpid()
    names = (
        preferred / f"ray-{pid}",
        Path(tempfile.gettempdir()) / f"vipe-ray-{os.getuid()}-{pid}",
        Path(f"/tmp/vipe-ray-{os.getuid()}-{pid}"),
    )
    chosen = next((name for name in names if len(str(name)) + _SESSION_PATH_CHARS <= _MAX_SOCKET_PATH), names[-1])
    for old in chosen.parent.glob(chosen.name.removesuffix(str(pid)) + "*"):
        owner = old.name.rsplit("-", 1)[-1]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(old, ignore_errors=True)
    chosen.mkdir(parents=True, exist_ok=True, mode=0o700)
    return chosen


def _ensure_gone(pid: int) -> None:
    """Wait a moment for Ray to end a process of this machine; one that hangs gets the signal that cannot be ignored."""
    deadline = time.monotonic() + _KILL_PATIENCE_S
    while Path(f"/proc/{pid}").exists():
        if time.monotonic() > deadline:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            return
        time.sleep(0.02)


def _died(error: Exception) -> Died:
    """One line out of Ray's paragraph."""
    from ray.exceptions import ActorDiedError, GetTimeoutError, NodeDiedError, OutOfMemoryError

    if isinstance(error, GetTimeoutError):
        return Died("the process was not ready in time")
    if isinstance(error, OutOfMemoryError):
        return Died("the machine ran out of memory, Ray ended the process")
    preempted = isinstance(error, NodeDiedError) or (isinstance(error, ActorDiedError) and error.preempted)
    text = " ".join(str(error).split())
    for known in ("out of memory", "node has died", "killed by `ray.kill`"):
        if known in text and "OOM killer" not in text:
            return Died(f"{type(error).__name__}: {known}", preempted or known == "node has died")
    if "connection error code 2" in text:
        return Died("the process ended without a word: a crash, or it was killed", preempted)
    return Died(f"{type(error).__name__}: {text[-300:]}", preempted)
