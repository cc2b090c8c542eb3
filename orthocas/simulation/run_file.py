"""Reading files of simulated runs: NPZ files whose header is JSON in an array of text."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from orthocas.errors import TrajectoryFileError
from orthocas.files.json import from_strict_json
from orthocas.files.npy import Stored, from_npy
from orthocas.files.zips import unpacking


def read_run_file(
    path: Path, version: int, names: Sequence[str], later: Sequence[str] = ()
) -> tuple[dict[str, Any], dict[str, Stored]]:
    """Header and the named arrays of a run, and the later ones if the file has them; other entries are left alone.

    Raises:
        TrajectoryFileError: if the file is missing, damaged, foreign or from a newer version.
    """
    with unpacking(path, "trajectory", TrajectoryFileError) as zipped:
        entries = ["header", *names, *(name for name in later if f"{name}.npy" in zipped.sizes)]
        zipped.require_room([f"{name}.npy" for name in entries])
        try:
            stored = {name: from_npy(zipped.read(f"{name}.npy")) for name in entries}
            header = from_strict_json(str(stored.pop("header")))
        except ValueError as error:
            if isinstance(error, TrajectoryFileError):
                raise
            raise TrajectoryFileError(f"{path} contains an array or a header that cannot be read: {error}") from None
    if not isinstance(header, dict) or header.get("version") != version:
        found = header.get("version") if isinstance(header, dict) else None
        raise TrajectoryFileError(f"{path} has version {found}, this orthocas reads {version}")
    return header, stored
