"""CasADi functions as C code to embed in our files: static, free of warnings, without CasADi's own interface."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import casadi as ca

from orthocas.codegen.own_code import with_own_code
from orthocas.codegen.work_arrays import compacted

_OPTIONS: dict[str, Any] = {"with_header": False, "with_export": False, "casadi_int": "int"}
_FUNCTION = re.compile(r"^(?:static |inline |const )*\w+\s?\*?\s+\**(\w+)\((.*)", re.DOTALL)
_DATA = re.compile(r"^static const \w+ (\w+)\[")


@dataclass(frozen=True)
class Kernels:
    """C code of functions `static int PREFIX_NAME(const double** arg, double** res, int* iw, double* w, int mem)`."""

    code: str
    work: dict[str, tuple[int, int, int, int]]  #: lengths of arg, res, iw and w that a call needs, by function name

    def sizes(self) -> dict[str, str]:
        """Values of the placeholders for these lengths: NAME_arg, NAME_res, NAME_iw and NAME_w."""
        return {
            f"{kernel}_{word}": str(max(1, size))
            for kernel, sizes in self.work.items()
            for word, size in zip(("arg", "res", "iw", "w"), sizes, strict=True)
        }

    def array_bytes(self, name: str, number_size: int) -> int:
        """Size of the work arrays that a call of a function needs, with numbers of a size, in bytes."""
        arg, res, iw, w = self.work[name]
        return 8 * (arg + res) + number_size * w + 4 * iw


def generate_kernels(
    functions: list[ca.Function], prefix: str, own_code: Mapping[str, str] = MappingProxyType({})
) -> Kernels:
    """Generate C99 for functions. Shared code appears once, and unused code is left out.

    Args:
        functions: functions with different names.
        prefix: prefix of every C name that the code defines.
        own_code: C bodies for functions by name, instead of those that CasADi writes; all functions hand `mem` on.
    """
    generator = ca.CodeGenerator("kernels.c", _OPTIONS)
    for function in functions:
        generator.add(function)
    items, doubles = compacted(_definitions(_with_products_of_known_sizes(generator.dump())), functions)
    items = with_own_code(items, functions, own_code)
    names = [function.name() for function in functions]
    code = "\n\n".join(_without_warnings(items[name]) for name in _needed(items, names))
    code = re.sub(r"\bcasadi_inf\b", "INFINITY", re.sub(r"\bcasadi_nan\b", "NAN", code))
    code = _with_explicit_conditions(code)
    code = re.sub(r"CASADI_CAST\((\w+), ([^()]+)\)", r"(\1)(\2)", code)
    code = re.sub(r"\bcasadi_real\b", "double", re.sub(r"\bcasadi_int\b", "int", code))
    code = re.sub(rf"\b(?:casadi_(?=\w)|(?={'|'.join(names)})(?=\w+\(const double\*\* arg))", f"{prefix}_", code)
    work = {f.name(): (f.sz_arg(), f.sz_res(), f.sz_iw(), doubles[f.name()]) for f in functions}
    return Kernels(code, work)


def _with_explicit_conditions(code: str) -> str:
    """Compare numbers with zero where C would convert them to truth values; clang warns of such conversions."""
    name = r"\(?(\*?\w+(?:\+\+|\[\w+\])?)\)?"
    code = re.sub(rf"\({name}\?", r"((\1 != 0)?", code)
    code = re.sub(rf"\(! ?{name} ?\)", r"(\1 == 0)", code)
    return re.sub(rf"\({name}(&&|\|\|){name}\)", r"((\1 != 0)\2(\3 != 0))", code)


_PRODUCT = re.compile(r"casadi_mtimes_dense\((\w+), (\d+), (\d+), (\w+), (\d+), (\w+), 0\)")


def _with_products_of_known_sizes(text: str) -> str:
    """Replace dense products by versions with constant sizes, which compilers vectorise; CasADi passes the sizes."""
    sizes = sorted({found.group(2, 3, 5) for found in _PRODUCT.finditer(text)})
    calls = _PRODUCT.sub(r"casadi_product_\2_\3_\5(\1, \4, \6)", text)
    return "\n\n".join([*(_product(*map(int, size)) for size in sizes), calls])


def _product(rows: int, columns: int, count: int) -> str:
    """C code for z += x y, with x (rows, columns) and y (columns, count). Four columns at a time save accesses to z."""
    fours = columns - columns % 4
    lines = [
        f"void casadi_product_{rows}_{columns}_{count}(const double* restrict x, const double* restrict y,"
        " double* restrict z) {",
        "  int i, j, k;",
        f"  for (i=0; i<{count}; ++i, y+={columns}, z+={rows}) {{",
        "    const double* xk = x;",
    ]
    for start, stop, step in ((0, fours, 4), (fours, columns, 1)):
        if start < stop:
            terms = " + ".join(f"xk[j+{c * rows}]*y[k+{c}]" for c in range(step))
            lines += [
                f"    for (k={start}; k<{stop}; k+={step}, xk+={step * rows}) {{",
                f"      for (j=0; j<{rows}; ++j) z[j] += {terms};",
                "    }",
            ]
    return "\n".join([*lines, "  }", "}"])


def _definitions(text: str) -> dict[str, str]:
    """Functions and constants by name, in order, without the preprocessor lines and comments between them."""
    found: dict[str, str] = {}
    lines = iter(text.splitlines())
    for line in lines:
        data = _DATA.match(line)
        name = data or _FUNCTION.match(line)
        if name is None:
            continue
        block = [line]
        while not (
            block[-1].endswith(";") if data else block[-1] == "}" or line.endswith("}")
        ):  # or the definition is a single line
            block.append(next(lines))
        found[name.group(1)] = "\n".join(block)
    return found


def _needed(items: dict[str, str], roots: list[str]) -> list[str]:
    """Names of everything that the roots use, directly or indirectly, in order of definition."""
    needed, waiting = set(), list(roots)
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            waiting += [word for word in set(re.findall(r"\w+", items[name])) if word in items and word != name]
    return [name for name in items if name in needed]


def _without_warnings(block: str) -> str:
    """Make a function static, and silence warnings about its unused parameters."""
    match = _FUNCTION.match(block)
    if match is None:
        return block
    head, body = block.split("{", 1)
    parameters = [part.split()[-1].lstrip("*") for part in head[head.index("(") + 1 : head.rindex(")")].split(",")]
    unused = [name for name in parameters if not re.search(rf"\b{name}\b", body)]
    silenced = "".join(f"\n  (void){name};" for name in unused)
    static = head if head.startswith("static") else f"static {head}"
    return f"{static}{{{silenced}{body}"
