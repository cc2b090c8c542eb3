"""CasADi functions as C that a file of ours can include: static, free of warnings, without CasADi's own interface."""

import re
from dataclasses import dataclass
from typing import Any

import casadi as ca

_OPTIONS: dict[str, Any] = {"with_header": False, "with_export": False, "casadi_int": "int"}
_FUNCTION = re.compile(r"^(?:static |inline |const )*\w+\s?\*?\s+\**(\w+)\((.*)", re.DOTALL)
_DATA = re.compile(r"^static const \w+ (\w+)\[")


@dataclass(frozen=True)
class Kernels:
    """C code of functions `static int PREFIX_NAME(const double** arg, double** res, int* iw, double* w, int mem)`."""

    code: str
    work: dict[str, tuple[int, int, int, int]]  #: by name: entries of arg, res, iw and w that a call needs

    @property
    def stack_bytes(self) -> int:
        """Bytes of work arrays that the largest call needs."""
        return max(8 * (arg + res + w) + 4 * iw for arg, res, iw, w in self.work.values())


def generate_kernels(functions: list[ca.Function], prefix: str) -> Kernels:
    """Generate C99 for functions; what they share is written once, what none needs is left out.

    Args:
        functions: with different names.
        prefix: of every C name that is defined.
    """
    generator = ca.CodeGenerator("kernels.c", _OPTIONS)
    for function in functions:
        generator.add(function)
    items = _definitions(generator.dump().replace(_ACROSS, _ALONG))
    names = [function.name() for function in functions]
    code = "\n\n".join(_without_warnings(items[name]) for name in _needed(items, names))
    code = re.sub(r"CASADI_CAST\((\w+), ([^()]+)\)", r"(\1)(\2)", code)
    code = re.sub(r"\bcasadi_real\b", "double", re.sub(r"\bcasadi_int\b", "int", code))
    code = re.sub(rf"\b(?:casadi_(?=\w)|(?={'|'.join(names)})(?=\w+\(const double\*\* arg))", f"{prefix}_", code)
    work = {f.name(): (f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w()) for f in functions}
    return Kernels(code, work)


# CasADi's product of dense matrices walks across the columns of x; along them, compilers can vectorise it.
_ACROSS = """      for (j=0; j<nrow_x; ++j) {
        for (k=0; k<ncol_x; ++k) {
"""
_ALONG = """      for (k=0; k<ncol_x; ++k) {
        for (j=0; j<nrow_x; ++j) {
"""


def _definitions(text: str) -> dict[str, str]:
    """Functions and constants by name, in order; preprocessor lines and comments between them are dropped."""
    found: dict[str, str] = {}
    lines = iter(text.splitlines())
    for line in lines:
        name = _FUNCTION.match(line) or _DATA.match(line)
        if name is None:
            continue
        block = [line]
        end = ";" if _DATA.match(line) else "}"
        while not (block[-1].endswith(";") if end == ";" else block[-1] == "}" or line.endswith("}")):
            block.append(next(lines))
        found[name.group(1)] = "\n".join(block)
    return found


def _needed(items: dict[str, str], roots: list[str]) -> list[str]:
    """Names of what the roots use, directly or not, in the order of definition."""
    needed, waiting = set(), list(roots)
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            waiting += [word for word in set(re.findall(r"\w+", items[name])) if word in items and word != name]
    return [name for name in items if name in needed]


def _without_warnings(block: str) -> str:
    """Make a function static, and say which parameters it does not use."""
    match = _FUNCTION.match(block)
    if match is None:
        return block
    head, body = block.split("{", 1)
    parameters = [part.split()[-1].lstrip("*") for part in head[head.index("(") + 1 : head.rindex(")")].split(",")]
    unused = [name for name in parameters if not re.search(rf"\b{name}\b", body)]
    silenced = "".join(f"\n  (void){name};" for name in unused)
    static = head if head.startswith("static") else f"static {head}"
    return f"{static}{{{silenced}{body}"
