"""The name of this machine's processor, as its system tells it: what measured times hold for. It decides nothing."""

import platform
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

COMM, CPUINFO = Path("/proc/self/comm"), Path("/proc/cpuinfo")
"""Linux: what runs this process, and one block of lines for each core."""
WINDOWS_KEY = r"HARDWARE\DESCRIPTION\System\CentralProcessor\0"


@lru_cache(maxsize=1)
def processor_name() -> str | None:
    """Such as "AMD EPYC 7763 64-Core Processor" or "Apple M2".

    None where the system tells no name, and under user-mode emulation, where the one it tells is of the processor
    beneath the emulated one.
    """
    ways = {"Linux": _linux_name, "Darwin": _macos_name, "Windows": _windows_name}
    try:
        name = ways.get(platform.system(), str)()
    except (OSError, subprocess.SubprocessError):
        return None
    return " ".join(name.split()) or None


def _linux_name() -> str:
    if COMM.read_text(encoding="utf-8", errors="replace").startswith("qemu-"):
        return ""
    cores = _fields(CPUINFO.read_text(encoding="utf-8", errors="replace"))
    if names := cores.get("model name"):
        return ", ".join(names)
    if parts := cores.get("CPU part"):  # ARM's kernel knows numbers alone
        return f"ARM part {', '.join(parts)} of implementer {', '.join(cores.get('CPU implementer', ['unknown']))}"
    return ""


def _fields(cpuinfo: str) -> dict[str, list[str]]:
    """The different values of each field, in order: large and small cores have names of their own."""
    found: dict[str, list[str]] = {}
    for line in cpuinfo.splitlines():
        key, _, value = (part.strip() for part in line.partition(":"))
        if value and value not in found.setdefault(key, []):
            found[key].append(value)
    return found


def _macos_name() -> str:
    command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=5, check=True).stdout  # noqa: S603


def _windows_name() -> str:
    if sys.platform == "win32":
        import winreg

        with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, WINDOWS_KEY) as key:
            return str(winreg.QueryValueEx(key, "ProcessorNameString")[0])
    return ""
