"""The pictures of docs/gallery.md: every reproduced figure of the paper, at page size (2 min)."""

import argparse
from pathlib import Path

from paper import reproduce
from PIL import Image

WIDTH = 1100  #: pixels, enough for a page


def main(out: Path, name: str = "all", quick: bool = False) -> dict[str, dict[str, float]]:
    """Draw figures, and shrink the pictures.

    Args:
        out: folder for pictures, numbers and meshes.
        name: a figure, or "all".
        quick: coarser figures.

    Returns:
        The numbers of each figure.
    """
    numbers = reproduce(name, out, quick)
    for figure in numbers:
        for path in out.glob(f"{figure}*.png"):
            shrink(path)
    return numbers


def shrink(path: Path) -> None:
    """Shrink a picture to at most WIDTH pixels, and keep all its colours."""
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((WIDTH, 10 * WIDTH))
    small.save(path, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gallery"))
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    main(arguments.out, quick=arguments.quick)
