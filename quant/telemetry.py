"""What the runtimes would tell their makers is switched off before they are loaded."""

import os
import sys


def switch_off_telemetry() -> None:
    """Keep onnxruntime and OpenVINO from reporting their use.

    onnxruntime's wheels (1.29 and later) keep an identifier in the home folder and send events from native code.
    That begins as the library is loaded, so its switch must be set before. OpenVINO reports its import through a
    package beside it; where that cannot be imported it takes a stub of its own. A choice made before is kept.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    absent: dict[str, object] = sys.modules  # type: ignore[assignment]  # None is Python's mark for "do not import"
    absent.setdefault("openvino_telemetry", None)
