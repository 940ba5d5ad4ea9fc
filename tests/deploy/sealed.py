"""The command line in a process that the kernel ends at its first internet socket.

    python -m tests.deploy.sealed restore raw.tif out.tif

Sockets of Python can be watched in Python, those of native libraries only in the kernel.
"""

import ctypes
import platform
import struct
import sys

SOCKET_CALL = {"x86_64": 41, "aarch64": 198}
"""Number of the system call socket(), by machine."""

AF_INET = 2
AF_INET6 = 10
LOAD = 0x20
JUMP_IF_EQUAL = 0x15
RETURN = 0x06
KILL_PROCESS = 0x80000000
ALLOW = 0x7FFF0000
CALL_OFFSET = 0
FIRST_ARGUMENT_OFFSET = 16
PR_SET_SECCOMP = 22
SECCOMP_MODE_FILTER = 2
PR_SET_NO_NEW_PRIVS = 38


class Program(ctypes.Structure):
    """The kernel's `struct sock_fprog`."""

    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_char_p))


def seal() -> None:
    """Let socket(AF_INET or AF_INET6) end this process and its children with SIGSYS.

    Raises:
        OSError: the kernel accepts no filters.
    """
    # The second and third numbers are the steps to skip if the operation is true and if it is
    # false.
    steps = [
        (LOAD, 0, 0, CALL_OFFSET),
        (JUMP_IF_EQUAL, 0, 3, SOCKET_CALL[platform.machine()]),
        (LOAD, 0, 0, FIRST_ARGUMENT_OFFSET),
        (JUMP_IF_EQUAL, 2, 0, AF_INET),
        (JUMP_IF_EQUAL, 1, 0, AF_INET6),
        (RETURN, 0, 0, ALLOW),
        (RETURN, 0, 0, KILL_PROCESS),
    ]
    # The kernel's `struct sock_filter`: 16 bits, two times 8 bits, 32 bits.
    code = b"".join(struct.pack("HBBI", *step) for step in steps)
    program = Program(len(steps), code)
    libc = ctypes.CDLL(None, use_errno=True)
    # From a process without privileges, the kernel accepts a filter only if it can gain none.
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(
        PR_SET_SECCOMP, SECCOMP_MODE_FILTER, ctypes.byref(program), 0, 0
    ):
        raise OSError(ctypes.get_errno(), "the kernel takes no seccomp filter")


if __name__ == "__main__":
    seal()
    from beers_deploy.cli.commands import app

    app(sys.argv[1:])
