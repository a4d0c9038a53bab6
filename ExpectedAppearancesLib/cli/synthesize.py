"""`synthesize CASE`: expected appearances."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..appearances import METHODS
from ..executor import LOCAL, check_executor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Makes images of what the cortex could look like: class-wise Gram texture synthesis (S_Theta). "
        "Interrupted, it goes on where it was. Default textures: the ones that ship with the project."
    )
    parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument("--textures", type=Path, metavar="DIR", help="folder of photographs with label maps")
    parser.add_argument(
        "--weights",
        metavar="FILE",
        help="VGG-16 or VGG-19 weights (.pth or .safetensors), or the word vgg19 for the official download; "
        "left out: the VGG-16 that ships",
    )
    parser.add_argument("--exclude", nargs="+", default=[], metavar="STYLE", help="textures to leave out")
    parser.add_argument(
        "--method",
        choices=METHODS,
        default="surface",
        help="surface: once per texture on the whole surface, any view rendered from it; "
        "image: the paper's, one optimisation per pose",
    )
    parser.add_argument(
        "--preset",
        choices=("default", "paper"),
        default="default",
        help="paper: method image, every pose with every texture, 256 px",
    )
    parser.add_argument("--size", type=int, help="height of the images, px; left out: 384 (surface) or 256 (image)")
    parser.add_argument("--seeds", type=int, default=1, help="surface: appearances per texture")
    parser.add_argument("--iterations", type=int, default=28, help="L-BFGS iterations")
    parser.add_argument("--batch", type=int, help="images optimised together; left out: as many as memory allows")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    parser.add_argument(
        "--executor",
        default=LOCAL,
        help="local, or dask://HOST:PORT of a dask scheduler whose workers reach CASE under the same path",
    )


def run(args, progress) -> None:
    from ..case.case import Case
    from ..errors import Problems
    from ..textures.library import read_library, shipped_textures_folder

    problems = Problems()
    case = textures = None
    with problems.collect():
        case = Case.open(args.case)
    with problems.collect():
        textures = read_library(args.textures or shipped_textures_folder(), args.exclude)
    for name, least in (("size", 32), ("seeds", 1), ("iterations", 1), ("batch", 1)):
        value = getattr(args, name)
        if value is not None and value < least:
            problems.add(f"--{name}: {value}; give at least {least}.")
    with problems.collect():
        check_executor(args.executor)
    problems.raise_if_any()
    from ..runs.record import exclusive

    # Processes and machines that make the same appearances divide the work.
    with exclusive(case.folder, "synthesize", work=_work(args, textures)):
        _synthesize(args, case, textures, progress)


def _work(args, textures) -> str:
    import hashlib

    given = [args.method, args.preset, args.size, args.seeds, args.iterations, str(args.weights)]
    return hashlib.sha256(repr(given + sorted(t.sha256 for t in textures)).encode()).hexdigest()


def _synthesize(args, case, textures, progress) -> None:
    from ..appearances.contact_sheet import write_contact_sheet
    from ..appearances.stage import synthesize_case
    from ..appearances.vgg import download_vgg19
    from ..devices import choose_device
    from ..errors import InputError
    from ..textures.library import is_shipped

    paper = args.preset == "paper"
    method = "image" if paper else args.method
    weights = args.weights
    if weights == "vgg19":
        weights = download_vgg19(Path.home() / ".cache" / "expected-appearances")
    if not textures:
        raise InputError(f"{args.textures}: no texture is left after --exclude; leave fewer out.")
    # Where a panel finds them again; '' for those that ship, which a panel names too and nobody may add to.
    own = args.textures and not is_shipped(args.textures)
    case.record("synthesize", textures_folder=str(args.textures.absolute()) if own else "")
    distances = synthesize_case(
        case,
        textures,
        progress,
        method,
        args.size or (384 if method == "surface" else 256),
        args.seeds,
        paper,
        args.iterations,
        weights,
        args.batch,
        choose_device(args.device),
        args.executor,
    )
    listed = ", ".join(f"{name} {distance:.3f}" for name, distance in distances.items())
    print(f"Gram distance to the texture, mean by class (0: same, fp32): {listed}")
    sheet = write_contact_sheet(case, method, textures)
    print(f"Contact sheet of masks, textures and appearances: {sheet}")
