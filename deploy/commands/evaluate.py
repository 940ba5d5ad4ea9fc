"""`beers-deploy evaluate`: several restorations on the same pairs, judged by the same instruments."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands.shared import say
from model.processor import SEEDS
from model.shipped import SENSOR

EXAMPLE = "evaluate --images aerial/ --methods degraded,traditional,convbeers-s,convbeers-s-int8 --out report/"


def evaluate(
    images: Annotated[
        Path | None, typer.Option(help="Folder of scenes to simulate from; drawn ones if none.")
    ] = None,
    pairs: Annotated[
        Path | None, typer.Option(help="Folder with degraded/ and reference/, as 'simulate' writes.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help=f"Profile of the degraded images; of pairs the recipe's, else {SENSOR} if none."),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(help="Profile of the reference images, in the sensor's DN; pleiades-reference if none."),
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Names, separated by commas.")
    ] = "degraded,traditional,deconvolve-first,convbeers-s,convbeers-s-int8",
    lpips: Annotated[
        Path | None, typer.Option(help="Weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for report.html and picture strips.")] = None,
    sweep: Annotated[
        bool, typer.Option("--sweep", help="Also PSNR and MTF under other blurs, noises and gains.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of every random draw.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Compare restorations with the reference, on average and by site; the degraded input is always a row.

    PSNR leaves out clipped pixels. MTF and SNR are measured on restored slanted edges and flat fields. Traditional
    methods know both sensors' nominal figures; networks are blind, but may have been made for the sensor.
    """
    from deploy.methods import method_named
    from deploy.report.evaluation_page import evaluation_report, pictures
    from deploy.report.page import write_report
    from deploy.results import Document, print_rows
    from model.evaluation.pairs import oversampling_note, profiles_for, read_pairs_recipe
    from model.evaluation.run import evaluate_methods, input_files, load_pairs, sweep_tables
    from model.evaluation.scores import Instruments, perceptual_distances
    from model.io.files import require_writable
    from model.metrics.bootstrap import LEAST_SITES
    from profiles.errors import OptionError
    from profiles.figures import by_table

    if pairs is not None and (images is not None or sweep):
        expected = "no --images or --sweep beside it: pairs are as they are"
        raise OptionError("--pairs", expected=expected, got="both", remedy="leave one out")
    names = list(dict.fromkeys(["degraded", *(name.strip() for name in methods.split(","))]))
    folders = [pairs, *(pairs / role for role in ("degraded", "reference"))] if pairs else [images]
    read = (*folders, lpips, *(Path(name) for name in (sensor, reference, *names) if name))
    require_writable(out / "report.html" if out else None, json, inputs=read, folders=(out,))
    recipe = read_pairs_recipe(pairs) if pairs is not None else None
    sensors = profiles_for(sensor, reference, recipe, say)
    chosen = [method_named(name, sensors[0].nominal(), sensors[1].nominal(), sensors[0].name) for name in names]
    instruments = Instruments(perceptual_distances(lpips), sensors[0].nominal().max_dn)
    found, small = load_pairs(images, pairs, *sensors, seed, recipe)
    result = evaluate_methods(chosen, found, instruments, sensors[0].nominal(), seed)
    title = f"{sensors[0].name} -> {sensors[1].name}, {len(found)} image{'' if len(found) == 1 else 's'}"
    print_rows(title, result.mean)
    swept = sweep_tables(chosen, images, *sensors, seed) if sweep else ()
    for table, rows in by_table((*result.sites, *swept)).items():
        print_rows(table, rows)
    sites = len({pair.site for pair in found})
    if sites < LEAST_SITES:
        say(f"no interval over sites is shown: of {sites}, fewer than {LEAST_SITES}, none could be trusted")
    sampled = oversampling_note(found, sensors[0])
    if sampled:
        say(sampled)
    if small:
        say(f"left out, too small: {', '.join(small)}")
    if out is not None:
        strips = pictures(found, chosen, out)
        write_report(evaluation_report(title, result.mean, result.sites, swept, strips, sampled), out / "report.html")
        say(f"wrote {out / 'report.html'}")
    arguments: dict[str, object] = {
        "images": images,
        "pairs": pairs,
        "sensor": sensor or sensors[0].name,
        "reference": sensors[1].name,
    }
    arguments |= {"methods": methods, "lpips": lpips, "out": out, "sweep": sweep, "seed": seed}
    Document("evaluate", arguments, input_files(names, images, pairs, lpips), (*result.rows, *swept)).write(json)
