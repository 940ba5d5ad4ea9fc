"""`beers-deploy restore` in the processing toolbox of QGIS.

Choose Scripts, Add Script to Toolbox, then this file. QGIS has a Python of its own, and this tool
another one, so the script starts the program and imports nothing of it. The names of methods are
QGIS's (https://docs.qgis.org/latest/en/docs/user_manual/processing/scripts.html).
"""

import os
import subprocess
from typing import Any

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterRasterDestination,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterString,
)

PROGRAM = "PROGRAM"
IMAGE = "IMAGE"
SENSOR = "SENSOR"
OUT = "OUT"


class RestoreImage(QgsProcessingAlgorithm):
    """The command `beers-deploy restore IMAGE OUT --cog`."""

    def name(self) -> str:
        """Return the name in models and in `qgis_process`."""
        return "restoreimage"

    def displayName(self) -> str:  # noqa: N802
        """Return the name in the toolbox."""
        return "Restore a raw satellite image"

    def createInstance(self) -> "RestoreImage":  # noqa: N802
        """Return a new instance, because QGIS runs each one in a thread."""
        return RestoreImage()

    def initAlgorithm(self, configuration: Any = None) -> None:  # noqa: N802, ARG002
        """Add the fields of the form."""
        self.addParameter(QgsProcessingParameterRasterLayer(IMAGE, "Raw image"))
        self.addParameter(
            QgsProcessingParameterString(SENSOR, "Sensor (empty: not known)", optional=True)
        )
        self.addParameter(
            QgsProcessingParameterString(PROGRAM, "Path of beers-deploy", "beers-deploy")
        )
        self.addParameter(QgsProcessingParameterRasterDestination(OUT, "Restored image, .tif"))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        """Restore the image. The last line of the program's messages becomes the error of QGIS.

        Raises:
            QgsProcessingException: the program ended with an error, or cannot be started.
        """
        image = self.parameterAsRasterLayer(parameters, IMAGE, context).source()
        out = self.parameterAsOutputLayer(parameters, OUT, context)
        program, sensor = (
            self.parameterAsString(parameters, key, context) for key in (PROGRAM, SENSOR)
        )
        command = [
            program,
            "restore",
            # QGIS itself asks before it writes over a file.
            "--overwrite",
            image,
            out,
            "--cog",
            *(["--sensor", sensor] if sensor else []),
        ]
        feedback.pushCommandInfo(" ".join(command))
        # These variables hold the paths of QGIS's own Python. Another Python must not use them.
        environment = {
            key: value for key, value in os.environ.items() if not key.startswith("PYTHON")
        }
        try:
            process = subprocess.run(  # noqa: S603 - the user's own program
                command,
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                check=False,
                env=environment,
            )
        except OSError as error:
            raise QgsProcessingException(
                f"{program} cannot be started: {error.strerror}. Give its whole path."
            ) from error
        # Notes and warnings come on standard error, the figures on standard output.
        lines = process.stderr.splitlines()
        if process.returncode:
            reason = lines[-1] if lines else f"{program} ended with {process.returncode}."
            raise QgsProcessingException(reason)
        feedback.pushInfo("\n".join([*lines, process.stdout]))
        return {OUT: out}
