"""Write docs/explanation/effects.md and its picture: each effect alone, all together, and the plans
of four scenes.

Run `python docs/make/effects.py` after a change to the simulator.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from beers_deploy.model.io.pictures import Stretch, strip
from beers_deploy.model.simulator.acquire import prepare_scene, scene_side_px, simulate_planned
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.plan import ORDER, TOLERANCE_DN, make_plan, scene_stats
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.effects import TABLES, settled
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.scene_call import SceneCall, calling_for, typical_effects
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import scene_names

DOCS = Path(__file__).parents[1]
PAGE = DOCS / "explanation" / "effects.md"
PICTURE = DOCS / "assets" / "effects.png"
RATIO = 5
SIDE_PX = 96
COLUMNS = 6

SHOWN: dict[str, dict[str, float]] = {
    "smear": {"length_px": 3.0},
    "full_well": {"radiance": 150.0},
    "prnu": {"rms": 0.03},
    "dsnu": {"rms_dn": 15.0},
    "striping": {"odd_even_dn": 40.0},
    "offset": {"offset_dn": 300.0},
    "defects": {"dead_per_million": 2000.0, "hot_per_million": 2000.0},
}
"""Stronger than typical, or the eye would not see them."""

HEAD = """# The simulator's effects

    beers-deploy simulate --scene night-port --explain

prints for each effect whether a scene gets it, and why.

![One crop of a synthetic scene: blur and noise, then each effect added alone, then all](../assets/effects.png)

Every sensor blurs, samples, adds noise and digitises. The other effects, {count} of them, apply when a sensor profile
or a scene has their table; `profiles/effects.toml` has typical values. In the picture they are stronger, to be seen.

They apply in the order of the signal: one transfer function for MTF, anti-alias filter and smear; sampling; then
{order}; `veil` is haze. The MTF that a profile states includes the anti-alias filter, but not smear.

## Which effects a scene gets

A bound is the largest change that any pixel could undergo, in DN before digitising, proven from the scene's radiances
and the kernels' sizes. Effects that change a scene by at most {tolerance:g} DN together are left out. The four shipped scenes
under `pleiades-degraded` have these effects, with these bounds:

"""


def document() -> str:
    """Return the page as Markdown."""
    scene = procedural_scene(1500, 1500, np.random.default_rng(0)).radiance
    order = ", ".join(ORDER[ORDER.index("sampling") + 1 :])
    count = len(TABLES)
    head = HEAD.format(count=count, order=order, tolerance=TOLERANCE_DN)
    return head + "\n".join(bounds(scene)) + "\n"


def plain() -> Instrument:
    """Return a sensor without optional effects."""
    return Sensor.load("pleiades-degraded").nominal()


def figure() -> Image.Image:
    """Draw a grid of crops: without optional effects, with each alone, and with all."""
    side = scene_side_px(SIDE_PX, RATIO)
    radiance = procedural_scene(3520, 3520, np.random.default_rng(0)).radiance
    scene = prepare_scene(radiance[2000 : 2000 + side, 2300 : 2300 + side], RATIO)
    typical = settled(typical_effects(), lambda constant: constant.middle)
    effects = {name: replace(effect, **SHOWN.get(name, {})) for name, effect in typical.items()}
    sensors = {"blur and noise": plain()}
    sensors |= {f"+ {name}": replace(plain(), effects={name: effects[name]}) for name in TABLES}
    sensors["all"] = replace(plain(), effects=effects)
    images = [
        (name, simulate_planned(scene, sensor, Draw(0), make_plan(sensor, scene.stats)))
        for name, sensor in sensors.items()
    ]
    rows = [dict(images[k : k + COLUMNS]) for k in range(0, len(images), COLUMNS)]
    strips = [strip(row, [(0, 0)], SIDE_PX, 2, Stretch(0.0, 2600.0)) for row in rows]
    canvas = Image.new("L", (max(s.width for s in strips), sum(s.height for s in strips)), 255)
    for k, picture in enumerate(strips):
        canvas.paste(picture, (0, k * strips[0].height))
    return canvas


def bounds(radiance: np.ndarray) -> Iterator[str]:
    """Yield a Markdown line for each scene, with the bounds of the effects that it has."""
    for name in scene_names():
        call = SceneCall.load(name)
        sensor = calling_for(Sensor.load("pleiades-degraded"), call).nominal()
        plan = make_plan(sensor, scene_stats(radiance * call.radiance_scale.low, RATIO))
        effects = ", ".join(
            f"{decision.effect} {decision.bound_dn:.3g}"
            for decision in plan.decisions
            if decision.bound_dn
        )
        yield f"- **{name}**: {effects}"


if __name__ == "__main__":
    figure().save(PICTURE, optimize=True)
    PAGE.write_text(document(), encoding="utf-8", newline="\n")
    print(f"wrote {PICTURE} and {PAGE}")
