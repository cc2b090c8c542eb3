"""The libraries that charts are exported to: what differs between their modules."""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Library:
    """A library with the functions of NumPy under its own name. `templates/NAME.py.in` has what it needs besides."""

    title: str
    prefix: str  #: of its functions in code
    imports: tuple[str, ...]  #: the standard library, an empty line, others
    erf: tuple[str, str]  #: its error function, and what that imports
    constants: str
    note: str

    def code(self, text: str) -> str:
        """Code for NumPy as code for this library."""
        return re.sub(r"\bnp\.", f"{self.prefix}.", text).replace("_erf(", f"{self.erf[0]}(")

    def imports_for(self, code: str) -> str:
        """The imports that a module's code needs."""
        lines = list(self.imports)
        if f"{self.erf[0]}(" in code and self.erf[1] not in lines:
            lines.insert(0 if self.erf[1] == "import math" else lines.index("") + 1, self.erf[1])
        return "\n".join(lines)


_COMMON = ("from base64 import b64decode", "from functools import cache")
LIBRARIES = {
    "numpy": Library(
        title="NumPy",
        prefix="np",
        imports=(*_COMMON, "", "import numpy as np"),
        erf=("np.vectorize(math.erf)", "import math"),
        constants="ROWS = 1024  # joint positions at once, so that intermediate values stay in the cache\n",
        note="Single precision if q is numpy.float32, double otherwise.",
    ),
    "torch": Library(
        title="PyTorch",
        prefix="torch",
        imports=("import struct", *_COMMON, "", "import torch"),
        erf=("torch.erf", "import torch"),
        constants="ROWS = 8192  # joint positions at once, so that memory stays bounded; raise it on a GPU\n",
        note="q is a floating-point tensor. Results have its precision and device, and are differentiable.",
    ),
    "jax": Library(
        title="JAX",
        prefix="jnp",
        imports=(*_COMMON, "", "import jax.numpy as jnp", "import numpy"),
        erf=("jax.scipy.special.erf", "import jax"),
        constants="",
        note="Results have the precision of q, and are differentiable; `jax_enable_x64` allows double precision.",
    ),
}
