"""The sensor simulator: from a scene's radiance to the digital numbers of an instrument.

- `sampling` reads scenes and samples them onto the sensor's grid, `procedural` draws one by `drawing`'s shapes;
- `mtf` is the blur, in Fourier; `detector` what detectors and electronics do afterwards, noise among it;
- `plan` decides, with proven bounds, which optional effects a scene can show; `acquire` puts all in order.
"""

from model.simulator.acquire import Pair, simulate_pair
from model.simulator.detector import Draw, to_dn, to_radiance
from model.simulator.mtf import sensor_transfer
from model.simulator.plan import Plan, make_plan
from model.simulator.procedural import procedural_scene
from model.simulator.sampling import Scene, read_scene, resample

__all__ = [
    "Draw",
    "Pair",
    "Plan",
    "Scene",
    "make_plan",
    "procedural_scene",
    "read_scene",
    "resample",
    "sensor_transfer",
    "simulate_pair",
    "to_dn",
    "to_radiance",
]
