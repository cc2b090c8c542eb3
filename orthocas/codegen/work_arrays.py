"""Work arrays of generated functions, without the space that CasADi reserves in them for constants.

CasADi's C refers to constants directly, but reserves a slot for each of them in its work array. For a network of a
thousand neurons, that is megabytes of stack that nothing reads or writes.
"""

import re
from itertools import pairwise

import casadi as ca

from orthocas.errors import CompileError

_VERSION = f"by CasADi {ca.CasadiMeta.version()}"
_PLACE = re.compile(r"\*w(\d+)=w\+(\d+)")
_CALL = re.compile(r"\bcasadi_f\d+(?=\(arg1, res1, iw, w, 0\))")


def compacted(blocks: dict[str, str], functions: list[ca.Function]) -> tuple[dict[str, str], dict[str, int]]:
    """C code with smaller work arrays, and the number of doubles that each function needs.

    Args:
        blocks: C code by name; called functions are casadi_f0, casadi_f1, ... in the order in which CasADi meets them.
        functions: the functions that the code was generated from, in the same order.

    Raises:
        CompileError: if a new version of CasADi lays the code out in another way.
    """
    names = {hash(f): f"casadi_f{number}" for number, f in enumerate(in_order_of_generation(functions))}
    changed = dict(blocks)
    needed: dict[str, int] = {}

    def need(function: ca.Function) -> int:
        name = names[hash(function)]
        if name not in needed:
            callees = _callees(function)
            if set(_CALL.findall(blocks[name])) != {names[hash(callee)] for callee in callees}:
                raise CompileError(f"the C code of {function.name()} does not call what its graph calls, {_VERSION}")
            below = max(map(need, callees), default=0)
            changed[name], needed[name] = _moved(blocks[name], function, below)
        return needed[name]

    return changed, {function.name(): need(function) for function in functions}


def in_order_of_generation(functions: list[ca.Function]) -> list[ca.Function]:
    """The functions and all that they call, callers before callees."""
    found: dict[int, ca.Function] = {}

    def visit(function: ca.Function) -> None:
        if hash(function) not in found:
            found[hash(function)] = function
            for callee in _callees(function):
                visit(callee)

    for function in functions:
        visit(function)
    return list(found.values())


def _callees(function: ca.Function) -> list[ca.Function]:
    if not function.is_a("MXFunction"):
        return []
    calls = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CALL]
    return [function.instruction_MX(k).which_function() for k in calls]


def _moved(block: str, function: ca.Function, below: int) -> tuple[str, int]:
    """Code whose slots in the work array begin at `below`, and the end of these slots."""
    body = _PLACE.sub("", block.split("{", 1)[1])
    if re.search(r"\bw\b", re.sub(rf"{_CALL.pattern}\(arg1, res1, iw, w, 0\)", "", body)):
        return block, function.sz_w()  # an operation uses the array in a way of its own
    sizes = _place_sizes(function)
    places = sorted((int(offset), sizes[int(place)]) for place, offset in _PLACE.findall(block))
    for (offset, size), (following, _) in pairwise(places):
        if offset + size > following:
            raise CompileError(f"work slots at {offset} and {following} of {function.name()} overlap, {_VERSION}")
    if not places:
        return block, below
    shift = below - places[0][0]
    return _PLACE.sub(lambda found: f"*w{found[1]}=w+{int(found[2]) + shift}", block), sum(places[-1]) + shift


def _place_sizes(function: ca.Function) -> dict[int, int]:
    """Size of every slot of the work array, in numbers."""
    found: dict[int, int] = {}
    for k in range(function.n_instructions() if function.is_a("MXFunction") else 0):
        node = function.instruction_MX(k)
        places = [] if function.instruction_id(k) == ca.OP_OUTPUT else function.instruction_output(k)
        for index, place in enumerate(places):
            if function.instruction_id(k) == ca.OP_CALL:
                found[place] = node.which_function().nnz_out(index)
            else:
                found[place] = (node.get_output(index) if len(places) > 1 else node).nnz()
    return {place: size for place, size in found.items() if place >= 0}
