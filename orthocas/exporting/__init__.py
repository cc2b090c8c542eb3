"""Charts as small modules of NumPy, PyTorch or JAX that do not need orthocas: `export`.

- `export` puts a module together and writes it.
- `tapes` writes expressions as lines of code, `forms` the coordinates: tables of products, networks, or such lines.
- `templates` holds what all modules share, and what each library needs of its own.
"""

from orthocas.exporting.export import export
from orthocas.exporting.libraries import LIBRARIES

__all__ = ["LIBRARIES", "export"]
