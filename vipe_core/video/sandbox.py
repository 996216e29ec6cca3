"""What a decoder child gives up before it looks at the first untrusted byte, as far as the platform lets it.

Nothing here needs privileges, and whatever is missing (another kernel, a container's own filter, macOS) is left out and
not reported: media is then still opened without a protocol and decoded in a process that can be killed.

    limits      memory, size of written files, open files, core dumps (every POSIX system; memory only on Linux)
    privileges  capabilities dropped, none gained by executing anything (Linux)
    seccomp     no sockets, no new processes, no tracing, no signals to others (Linux on x86-64 and arm64)
    landlock    no files but the code of Python and of the system's libraries, and nothing is written (Linux 5.13)
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import struct
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

PROTECTIONS = ("limits", "privileges", "landlock", "seccomp")

_PACKAGE_ROOT = Path(__file__).resolve().parents[1]
# Standard error goes to a file; a few lines must fit.
_MAX_WRITTEN_FILE_BYTES = 1 << 20
_SPARE_FILES = 64

_PR_SET_NO_NEW_PRIVS = 38
_PR_CAPBSET_DROP = 24
_CAPABILITY_VERSION_3 = 0x20080522

_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
# (x86-64, arm64); None where the architecture does not have the call.
_DENIED: dict[str, tuple[int | None, int | None]] = {
    "socket": (41, 198),
    "socketpair": (53, 199),
    "connect": (42, 203),
    "bind": (49, 200),
    "listen": (50, 201),
    "accept": (43, 202),
    "accept4": (288, 242),
    "sendto": (44, 206),
    "sendmsg": (46, 211),
    "sendmmsg": (307, 269),
    "fork": (57, None),
    "vfork": (58, None),
    "execve": (59, 221),
    "execveat": (322, 281),
    "tkill": (200, 130),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_open": (434, 434),
    "pidfd_getfd": (438, 438),
    "open_by_handle_at": (304, 265),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "unshare": (272, 97),
    "setns": (308, 268),
    "open_tree": (428, 428),
    "fsopen": (430, 430),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "keyctl": (250, 219),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
}
_SIGNALS = ((62, 129), (234, 131))  # kill, tgkill
_CLONE = (56, 220)
_CLONE3 = 435
_CLONE_THREAD = 0x00010000
_X32 = 0x40000000

_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000
_EPERM, _ENOSYS = 1, 38
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENT_AT = 0, 4, 16
_SET_MODE_FILTER, _FILTER_ALL_THREADS = 1, 1
_SECCOMP = {"x86_64": 317, "aarch64": 277}

_LANDLOCK_CREATE, _LANDLOCK_ADD, _LANDLOCK_RESTRICT = 444, 445, 446
_LANDLOCK_READ = 1 << 2 | 1 << 3  # files and directories


def restrict(max_memory_bytes: int) -> tuple[str, ...]:
    """Give everything up that is not needed to decode what is open already. Cannot be undone.

    Import and open first what is needed; more code can still be imported.

    Args:
        max_memory_bytes: Private memory that the process may have on top of what it has.

    Returns:
        Names of the protections that are active, of the list above.
    """
    _limit(max_memory_bytes)
    active = ["limits"]
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        steps: tuple[tuple[str, Callable[[ctypes.CDLL], bool]], ...] = (
            ("privileges", _drop_privileges),
            ("landlock", _restrict_files),
            ("seccomp", _filter_calls),
        )
        active += [name for name, step in steps if step(libc)]
    return tuple(active)


def _limit(max_memory_bytes: int) -> None:
    highest = max((int(entry.name) for entry in Path("/dev/fd").iterdir() if entry.name.isdigit()), default=256)
    wanted = [
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, _MAX_WRITTEN_FILE_BYTES),
        (resource.RLIMIT_NOFILE, highest + _SPARE_FILES),
    ]
    if sys.platform == "linux":
        used_pages = int(Path("/proc/self/statm").read_text().split()[5])
        wanted.append((resource.RLIMIT_DATA, max_memory_bytes + used_pages * resource.getpagesize()))
    for kind, value in wanted:
        _, hard = resource.getrlimit(kind)
        bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (bound, bound))


def _drop_privileges(libc: ctypes.CDLL) -> bool:
    for capability in range(64):
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)  # Fails where there is nothing to drop, or no right to.
    header = struct.pack("<Ii", _CAPABILITY_VERSION_3, 0)
    dropped = libc.capset(header, bytes(24)) == 0
    return bool(libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0) and dropped


def _filter_calls(libc: ctypes.CDLL) -> bool:
    machine = platform.machine()
    if machine not in _ARCHITECTURES or sys.maxsize < 2**32:
        return False
    program = seccomp_program(machine, os.getpid())
    buffer = ctypes.create_string_buffer(program, len(program))
    filter_ = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(buffer))
    return bool(libc.syscall(_SECCOMP[machine], _SET_MODE_FILTER, _FILTER_ALL_THREADS, filter_) == 0)


def seccomp_program(machine: str, pid: int) -> bytes:
    """A filter in the kernel's classic BPF: what `_DENIED` names fails with EPERM, the rest is allowed.

    Args:
        machine: x86_64 or aarch64.
        pid: The only process that may be signalled.
    """
    column = list(_ARCHITECTURES).index(machine)
    refused = (_RETURN, 0, 0, _ERRNO | _EPERM)
    allowed = (_RETURN, 0, 0, _ALLOW)
    steps = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_EQUAL, 1, 0, _ARCHITECTURES[machine]),
        refused,
        (_LOAD, 0, 0, _NUMBER_AT),
    ]
    if machine == "x86_64":
        steps += [(_AT_LEAST, 0, 1, _X32), refused]
    for numbers in _DENIED.values():
        if (number := numbers[column]) is not None:
            steps += [(_EQUAL, 0, 1, number), refused]
    # The flags of clone3 lie in memory, where a filter cannot look; the C library then takes clone.
    steps += [(_EQUAL, 0, 1, _CLONE3), (_RETURN, 0, 0, _ERRNO | _ENOSYS)]
    steps += [(_EQUAL, 0, 4, _CLONE[column]), (_LOAD, 0, 0, _ARGUMENT_AT)]
    steps += [(_ANY_BIT, 1, 0, _CLONE_THREAD), refused, allowed]
    for call in _SIGNALS:
        steps += [(_EQUAL, 0, 4, call[column]), (_LOAD, 0, 0, _ARGUMENT_AT), (_EQUAL, 1, 0, pid), refused, allowed]
    steps.append(allowed)
    return b"".join(struct.pack("<HBBI", *step) for step in steps)


def _restrict_files(libc: ctypes.CDLL) -> bool:
    abi = libc.syscall(_LANDLOCK_CREATE, None, 0, 1)
    if abi < 1:
        return False
    rights = 13 + (abi >= 2) + (abi >= 3) + (abi >= 5)
    network = 0b11 if abi >= 4 else 0
    scopes = 0b11 if abi >= 6 else 0
    fields = (2**rights - 1, network, scopes)[: 1 if abi < 4 else 2 if abi < 6 else 3]
    attributes = struct.pack(f"<{len(fields)}Q", *fields)
    rules = libc.syscall(_LANDLOCK_CREATE, attributes, ctypes.c_size_t(len(attributes)), 0)
    if rules < 0:
        return False
    try:
        for folder in _code_folders():
            descriptor = os.open(folder, os.O_PATH | os.O_CLOEXEC)
            try:
                rule = struct.pack("<Qi", _LANDLOCK_READ, descriptor)
                if libc.syscall(_LANDLOCK_ADD, rules, 1, rule, 0) != 0:
                    return False
            finally:
                os.close(descriptor)
        return bool(libc.syscall(_LANDLOCK_RESTRICT, rules, 0) == 0)
    finally:
        os.close(rules)


def _code_folders() -> list[Path]:
    """Where Python and the libraries that it loads come from: nothing in there is a secret."""
    paths = sysconfig.get_paths()
    folders = {paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    folders |= {str(_PACKAGE_ROOT), "/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib"}
    return [folder for folder in map(Path, sorted(folders)) if folder.is_dir()]
