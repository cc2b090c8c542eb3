"""What `generate_c` leaves behind."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class GeneratedC:
    """The location and names of a generated library."""

    folder: Path
    name: str  #: prefix of every C name, and of the files
    stack_bytes: int  #: largest stack use of a call
    single_precision: bool = False  #: whether its numbers are `float`, not `double`
