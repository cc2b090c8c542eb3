"""How many public robot files open without a second try: `Robot.from_urdf(FILE)`, with no other argument.

The files are those of github.com/Daniella1/urdf_files_dataset, at commit 81f4cdac: arms, hands, grippers, legged and
mobile robots, from ROS packages, Drake, Matlab and manufacturers. Their folder is the argument.
"""

import argparse
import logging
import warnings
from pathlib import Path

import orthocas as oc
from orthocas.errors import OrthocasError, TipWarning


def main(folder: Path) -> dict[str, float]:
    """Open all files, print why some do not open; numbers by name."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore", TipWarning)
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() == ".urdf")
    opened = 0
    for path in files:
        try:
            oc.Robot.from_urdf(path)
            opened += 1
        except OrthocasError as error:
            print(f"{path.relative_to(folder)}: {str(error).removeprefix(str(path))}")
    print(f"{opened} of {len(files)} files open")
    return {"opened": opened, "files": len(files)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="a checkout of the collection")
    main(parser.parse_args().folder)
