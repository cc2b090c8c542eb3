"""What an installation holds: megabytes and distributions of the core, what each extra adds, and seconds to import.

Needs the package index: every extra is installed in a fresh environment of its own.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import venv
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent.parent
EXTRAS = ("robots", "xacro", "view", "mesh", "mujoco", "learn", "dask")
_IMPORTED = (
    "import sys, time; start = time.perf_counter(); import orthocas; orthocas.fit; print(time.perf_counter() - start)"
)


def main(extras: tuple[str, ...] = EXTRAS) -> dict[str, float]:
    """Install and measure; numbers by name."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", name, str(ROOT))
        (wheel,) = folder.glob("*.whl")
        megabytes, headers, count, seconds = measure(wheel, folder / "core")
        print("| installed | MB | distributions |\n| --- | --- | --- |")
        print(f"| `orthocas` | {megabytes:.0f} | {count} |")
        print(f"| of it, headers for C++ programs | {headers:.0f} | |")
        for extra in extras:
            more, _, others, _ = measure(f"{wheel}[{extra}]", folder / extra)
            print(f"| `[{extra}]` adds | {more - megabytes:.0f} | {others - count} |", flush=True)
    print(f"import of what fits: {seconds:.2f} s")
    return {"megabytes": megabytes, "headers": headers, "distributions": count, "import_s": seconds}


def measure(requirement: str | Path, folder: Path) -> tuple[float, float, int, float]:
    """Megabytes, those of headers, distributions and median seconds of an import, without pip and setuptools.

    Headers are removed before the import.
    """
    venv.create(folder, with_pip=True)
    python = str(folder / "bin" / "python")
    run(python, "-m", "pip", "install", "--quiet", "--no-compile", str(requirement))
    listed = json.loads(run(python, "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"))
    count = len({each["name"] for each in listed} - {"pip", "setuptools"})
    (packages,) = folder.glob("lib/python*/site-packages")
    files = [path for path in packages.rglob("*") if path.is_file() and not path.is_symlink()]
    own = [path for path in files if path.relative_to(packages).parts[0] not in ("pip", "setuptools", "pkg_resources")]
    places = [packages / "cmeel.prefix" / "include", packages / "casadi" / "include"]
    total, headers = (
        sum(path.stat().st_size for path in part) / 1e6
        for part in (own, [path for path in own if any(place in path.parents for place in places)])
    )
    for place in places:
        shutil.rmtree(place)
    seconds = statistics.median(float(run(python, "-c", _IMPORTED)) for _ in range(5))
    return total, headers, count, seconds


def run(*words: str) -> str:
    """What a command prints; raises if it fails."""
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the core alone")
    main(() if parser.parse_args().quick else EXTRAS)
