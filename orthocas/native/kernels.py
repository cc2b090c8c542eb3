"""C code from CasADi functions, with work arrays on the stack of the caller, and templates for the code around it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from orthocas.errors import CompileError

if TYPE_CHECKING:
    from jinja2 import Environment
    from jinja2.runtime import Context

LARGE_INVERSE = "large_inverse"  #: name of functions whose C code comes from a template
ROOT_TIMES = "root_times"  #: likewise
ROUNDS = 8  #: of a root; exact to rounding up to a condition number of 1e6 (tests/control/test_control_algebra.py)

_INFINITIES = {np.inf: "INFINITY", -np.inf: "-INFINITY"}
_VERSION = f"by CasADi {ca.CasadiMeta.version()}"
_PLACE = re.compile(r"\*w(\d+)=w\+(\d+)")
_CALL = re.compile(r"\bcasadi_f\d+(?=\(arg1, res1, iw, w, 0\))")
_FUNCTION = re.compile(r"^(?:static |inline |const )*\w+\s?\*?\s+\**(\w+)\((.*)", re.DOTALL)
_DATA = re.compile(r"^static const \w+ (\w+)\[")
_PRODUCT = re.compile(r"casadi_mtimes_dense\((\w+), (\d+), (\d+), (\w+), (\d+), (\w+), 0\)")


@dataclass(frozen=True)
class Kernels:
    """C code of functions `static int PREFIX_NAME(const double** arg, double** res, int* iw, double* w, int mem)`."""

    code: str
    work: dict[str, tuple[int, int, int, int]]  #: lengths of arg, res, iw and w that a call needs, by function name
    numbers: dict[str, int]  #: length of the first output, by function name
    prefix: str

    def sizes(self) -> dict[str, dict[str, int]]:
        """The lengths in `work` and `numbers` for templates, at least 1, by function name and array name."""
        words = ("arg", "res", "iw", "w", "numbers")
        return {
            name: {word: max(1, size) for word, size in zip(words, (*sizes, self.numbers[name]), strict=True)}
            for name, sizes in self.work.items()
        }

    def declare_arrays(self, name: str, numbers: str = "", integers: str = "") -> str:
        """C that declares the arrays for a call of a function.

        Args:
            name: name of the function.
            numbers: further doubles to declare, such as ", a, b".
            integers: further ints to declare.
        """
        arg, res, iw, w = (max(1, size) for size in self.work[name])
        lines = f"const double *arg[{arg}] = {{0}};", f"double *res[{res}] = {{0}};"
        return "\n  ".join([*lines, f"double w[{w}]{numbers};", f"int iw[{iw}]{integers};"])

    def write_call(self, name: str, inputs: list[str], outputs: list[str]) -> str:
        """C that calls a function with the arrays of `declare_arrays`.

        Args:
            name: name of the function.
            inputs: C expressions for the addresses of its inputs.
            outputs: C expressions for the addresses of its outputs.
        """
        lines = [f"arg[{i}] = {place};" for i, place in enumerate(inputs)]
        lines += [f"res[{i}] = {place};" for i, place in enumerate(outputs)]
        return "\n  ".join([*lines, f"{self.prefix}_{name}(arg, res, iw, w, 0);"])

    def array_bytes(self, name: str, number_size: int) -> int:
        """Size of the work arrays that a call of a function needs [bytes], with numbers of `number_size` bytes."""
        arg, res, iw, w = self.work[name]
        return 8 * (arg + res) + number_size * w + 4 * iw


def generate_kernels(functions: list[ca.Function], prefix: str) -> Kernels:
    """Generate C99 for functions. Shared code appears once, and unused code is left out.

    Args:
        functions: functions with different names.
        prefix: prefix of every C name that the code defines.
    """
    # CasADi writes the functions and all that they call, as casadi_f0, casadi_f1, ...
    generator = ca.CodeGenerator("kernels.c", {"with_header": False, "with_export": False, "casadi_int": "int"})
    for function in functions:
        generator.add(function)
    # Replace CasADi's dense products, which take sizes as arguments: compilers vectorise loops of constant length.
    text = generator.dump()
    sizes = sorted({result.group(2, 3, 5) for result in _PRODUCT.finditer(text)})
    calls = _PRODUCT.sub(r"casadi_product_\2_\3_\5(\1, \4, \6)", text)
    blocks = _split_definitions("\n\n".join([*(_write_product(*map(int, size)) for size in sizes), calls]))

    # Let functions reuse the work arrays of functions that have ended, and give inverses and roots faster bodies.
    blocks, doubles = _compact_work_arrays(blocks, functions)
    for number, function in enumerate(_order_functions(functions)):
        name = f"casadi_f{number}"
        if (body := _write_body(function, blocks[name])) is not None:
            blocks[name] = blocks[name].split("{", 1)[0] + body

    # Keep what is used, and turn it into C99 without warnings, with our prefix.
    names = [function.name() for function in functions]
    code = "\n\n".join(_silence_warnings(blocks[name]) for name in _find_needed(blocks, names))
    code = re.sub(r"\bcasadi_inf\b", "INFINITY", re.sub(r"\bcasadi_nan\b", "NAN", code))
    # Clang warns if numbers serve as truth values, so they are compared with zero.
    value = r"\(?(\*?\w+(?:\+\+|\[\w+\])?)\)?"
    code = re.sub(rf"\({value}\?", r"((\1 != 0)?", code)
    code = re.sub(rf"\(! ?{value} ?\)", r"(\1 == 0)", code)
    code = re.sub(rf"\({value}(&&|\|\|){value}\)", r"((\1 != 0)\2(\3 != 0))", code)
    # Replace types and names of CasADi by those of the library.
    code = re.sub(r"CASADI_CAST\((\w+), ([^()]+)\)", r"(\1)(\2)", code)
    code = re.sub(r"\bcasadi_real\b", "double", re.sub(r"\bcasadi_int\b", "int", code))
    code = re.sub(rf"\b(?:casadi_(?=\w)|(?={'|'.join(names)})(?=\w+\(const double\*\* arg))", f"{prefix}_", code)
    if re.search(r"\bpow\(", code):
        # Replace `pow`, which is slow on small processors.
        power = render("algebra.c", {"what": "power", "name": f"{prefix}_power"}).rstrip("\n")
        code = f"{power}\n\n" + re.sub(r"\bpow\(", f"{prefix}_power(", code)
    work = {f.name(): (f.sz_arg(), f.sz_res(), f.sz_iw(), doubles[f.name()]) for f in functions}
    return Kernels(code, work, {f.name(): f.numel_out(0) for f in functions}, prefix)


def _write_product(rows: int, columns: int, count: int) -> str:
    """C code for z += x y, with x (rows, columns) and y (columns, count).

    It takes four columns of x at a time, because then z is read and written less often.
    """
    fours = columns - columns % 4
    lines = [
        f"void casadi_product_{rows}_{columns}_{count}(const double* restrict x, const double* restrict y,"
        " double* restrict z) {",
        "  int i, j, k;",
        f"  for (i=0; i<{count}; ++i, y+={columns}, z+={rows}) {{",
        "    const double* xk = x;",
    ]
    # First the blocks of four columns, then the remaining columns.
    for start, stop, step in ((0, fours, 4), (fours, columns, 1)):
        if start < stop:
            terms = " + ".join(f"xk[j+{c * rows}]*y[k+{c}]" for c in range(step))
            lines += [
                f"    for (k={start}; k<{stop}; k+={step}, xk+={step * rows}) {{",
                f"      for (j=0; j<{rows}; ++j) z[j] += {terms};",
                "    }",
            ]
    return "\n".join([*lines, "  }", "}"])


def _split_definitions(text: str) -> dict[str, str]:
    """C code of functions and constants by name, in order, without preprocessor lines and comments between them."""
    result: dict[str, str] = {}
    lines = iter(text.splitlines())
    for line in lines:
        data = _DATA.match(line)
        name = data or _FUNCTION.match(line)
        if name is None:
            continue
        block = [line]
        # A constant ends with a semicolon. A function ends with a brace, on its first line if it is a one-liner.
        while not (block[-1].endswith(";") if data else block[-1] == "}" or line.endswith("}")):
            block.append(next(lines))
        result[name.group(1)] = "\n".join(block)
    return result


def _compact_work_arrays(blocks: dict[str, str], functions: list[ca.Function]) -> tuple[dict[str, str], dict[str, int]]:
    """C code with smaller work arrays, and the number of doubles that each function needs.

    Args:
        blocks: C code by name; called functions are casadi_f0, casadi_f1, ... in the order in which CasADi finds them.
        functions: the functions that the code was generated from, in the same order.

    Raises:
        CompileError: if a new version of CasADi writes code of another structure.
    """
    # A function must not overwrite the arrays of functions that it calls, so its own ones lie behind theirs.
    names = {hash(f): f"casadi_f{number}" for number, f in enumerate(_order_functions(functions))}
    changed = dict(blocks)
    needed: dict[str, int] = {}

    # The number of doubles that a function needs: those of its callees, then its own.
    def need(function: ca.Function) -> int:
        name = names[hash(function)]
        if name not in needed:
            callees = _find_callees(function)
            if set(_CALL.findall(blocks[name])) != {names[hash(callee)] for callee in callees}:
                raise CompileError(f"the C code of {function.name()} does not call what its graph calls, {_VERSION}")
            below = max(map(need, callees), default=0)
            changed[name], needed[name] = _move_slots(blocks[name], function, below)
        return needed[name]

    return changed, {function.name(): need(function) for function in functions}


def _order_functions(functions: list[ca.Function]) -> list[ca.Function]:
    """The functions and all that they call, callers before callees."""
    result: dict[int, ca.Function] = {}

    def visit(function: ca.Function) -> None:
        if hash(function) not in result:
            result[hash(function)] = function
            for callee in _find_callees(function):
                visit(callee)

    for function in functions:
        visit(function)
    return list(result.values())


def _find_callees(function: ca.Function) -> list[ca.Function]:
    if not function.is_a("MXFunction"):
        return []
    calls = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CALL]
    return [function.instruction_MX(k).which_function() for k in calls]


def _move_slots(block: str, function: ca.Function, below: int) -> tuple[str, int]:
    """C code of a function whose slots in the work array begin at `below`, and the end of its slots."""
    # Slots are declared as *w5=w+17. If the code uses the array in another way, it cannot be moved.
    body = _PLACE.sub("", block.split("{", 1)[1])
    if re.search(r"\bw\b", re.sub(rf"{_CALL.pattern}\(arg1, res1, iw, w, 0\)", "", body)):
        return block, function.sz_w()
    # Find the size of each slot. A call may have several outputs, each with a slot of its own.
    sizes: dict[int, int] = {}
    for k in range(function.n_instructions() if function.is_a("MXFunction") else 0):
        node = function.instruction_MX(k)
        slots = [] if function.instruction_id(k) == ca.OP_OUTPUT else function.instruction_output(k)
        for index, slot in enumerate(slots):
            if function.instruction_id(k) == ca.OP_CALL:
                sizes[slot] = node.which_function().nnz_out(index)
            else:
                sizes[slot] = (node.get_output(index) if len(slots) > 1 else node).nnz()
    # If slots do not overlap in CasADi's layout, all of them can be moved by the same shift.
    places = sorted((int(offset), sizes[int(place)]) for place, offset in _PLACE.findall(block))
    for (offset, size), (following, _) in pairwise(places):
        if offset + size > following:
            raise CompileError(f"work slots at {offset} and {following} of {function.name()} overlap, {_VERSION}")
    if not places:
        return block, below
    shift = below - places[0][0]
    return _PLACE.sub(lambda result: f"*w{result[1]}=w+{int(result[2]) + shift}", block), sum(places[-1]) + shift


def _write_body(function: ca.Function, block: str) -> str | None:
    """C body of an inverse or root of `orthocas.control.linear_algebra`, faster than CasADi's; None for others."""
    # Fixed names identify these functions.
    size = function.size1_in(0) if function.n_in() else 0
    if function.name() == LARGE_INVERSE:
        return render("algebra.c", {"what": "inverse", "size": size}).rstrip("\n")
    if function.name() != ROOT_TIMES:
        return None
    values = {
        "what": "root",
        "size": size,
        "count": function.size2_in(1),
        "below": min(int(offset) for _, offset in _PLACE.findall(block)),
        "rounds": ROUNDS,
        "newton_round": _CALL.findall(block)[0],
    }
    return render("algebra.c", values).rstrip("\n")


def _find_needed(items: dict[str, str], roots: list[str]) -> list[str]:
    """Names of everything that the roots use, directly or indirectly, in order of definition."""
    needed, waiting = set(), list(roots)
    while waiting:
        name = waiting.pop()
        if name not in needed:
            needed.add(name)
            waiting += [word for word in set(re.findall(r"\w+", items[name])) if word in items and word != name]
    return [name for name in items if name in needed]


def _silence_warnings(block: str) -> str:
    """Make a function static, and silence warnings about its unused parameters."""
    match = _FUNCTION.match(block)
    if match is None:
        return block
    head, body = block.split("{", 1)
    # Find the parameters that the body does not use
    parameters = [part.split()[-1].lstrip("*") for part in head[head.index("(") + 1 : head.rindex(")")].split(",")]
    unused = [name for name in parameters if not re.search(rf"\b{name}\b", body)]
    silenced = "".join(f"\n  (void){name};" for name in unused)
    static = head if head.startswith("static") else f"static {head}"
    return f"{static}{{{silenced}{body}"


def share_calls(functions: list[ca.Function], states: Mapping[str, int]) -> list[ca.Function]:
    """Move calls that several graphs make with q, or q and dq, into one graph `shared`.

    Args:
        functions: graphs whose first inputs are joint positions (n, 1).
        states: the graphs that share calls, by name: 1 if their first input is q, 2 if the second one is dq.

    Returns:
        The graph `shared` of (q, dq), and the graphs. Those that share take its output as an additional last input.
    """
    # Expand called graphs until the calls that several graphs make are calls of the graphs themselves.
    sharing = {function.name(): function for function in functions if function.name() in states}
    while True:
        called = [result for name, function in sharing.items() for result in _find_calls(function, states[name])]
        times = Counter(hash(function) for function, _ in called)
        several = {key for key, count in times.items() if count > 1}
        opened = partial(_open_call, but=several)
        changed = {name: result for name, function in sharing.items() if (result := _replace_calls(function, opened))}
        if not changed:
            break
        sharing |= changed

    # Give each common call a place in the output of `shared`.
    common = {hash(function): (function, inputs) for function, inputs in called if hash(function) in several}
    n = functions[0].size1_in(0)
    ends = np.cumsum([0, *(function.numel_out(0) for function, _ in common.values())]).tolist()
    places = {key: slice(*of) for key, of in zip(common, pairwise(ends), strict=True)}
    shared, state = ca.MX.sym("shared", max(1, ends[-1])), [ca.MX.sym(name, n) for name in ("q", "dq")]

    def take_shared(given: list[ca.MX], called: ca.Function, arguments: list[ca.MX]) -> ca.MX | None:
        place = places.get(hash(called)) if _are_first(arguments, given) else None
        return None if place is None else ca.reshape(shared[place], *called.size_out(0))

    # Replace the calls in the graphs by these places.
    for name, function in sharing.items():
        symbols = function.mx_in()
        with_shared = _replace_calls(function, partial(take_shared, symbols[: states[name]]), [shared])
        sharing[name] = with_shared or ca.Function(name, [*symbols, shared], function.call(symbols))
    values = [ca.vec(ca.densify(function(*state[:inputs]))) for function, inputs in common.values()] or [ca.MX(0)]
    whole = [sharing.get(function.name(), function) for function in functions]
    return [ca.Function("shared", state, [ca.vertcat(*values)]), *whole]


def _find_calls(function: ca.Function, states: int) -> list[tuple[ca.Function, int]]:
    """Functions that a graph calls with only q, or q and dq, each with the number of these inputs.

    Functions that those call with q are included.

    Args:
        function: the graph.
        states: number of its first inputs that are q and dq.
    """
    result: list[tuple[ca.Function, int]] = []
    given = function.mx_in()[:states]

    def collect(called: ca.Function, arguments: list[ca.MX]) -> None:
        # Their own calls with q may be shared as well.
        if _are_first(arguments, given):
            result.append((called, len(arguments)))
            result.extend(_find_calls(called, 1))

    _replace_calls(function, collect)
    return result


def _are_first(arguments: list[ca.MX], given: list[ca.MX]) -> bool:
    """Whether arguments are the first ones of the given symbols, in this order."""
    return len(arguments) <= len(given) and all(hash(a) == hash(b) for a, b in zip(arguments, given, strict=False))


def share_sines(functions: list[ca.Function]) -> list[ca.Function]:
    """Change graphs so that sines and cosines of joint positions are computed once for all called functions.

    Args:
        functions: graphs whose first inputs are joint positions (n, 1); others are returned as they are.
    """
    # Make one form of each called function, so that its code appears once.
    made: dict[int, ca.Function | None] = {}
    at = ca.SX.sym("q", max((function.size1_in(0) for function in functions), default=0))
    turns = ca.Function("turns", [at], [ca.sin(at), ca.cos(at)])

    # Calls with q get its sines and cosines as additional inputs.
    def take_given(called: ca.Function, arguments: list[ca.MX]) -> ca.MX | None:
        if called.size1_in(0) != at.shape[0]:
            return None
        if hash(called) not in made:
            made[hash(called)] = _take_sines(called)
        form = made[hash(called)]
        return None if form is None else form(*turns(arguments[0]), *arguments)

    # Expand called graphs until only functions without calls are called, so that every call with q is found.
    def rewrite(function: ca.Function) -> ca.Function:
        within = _replace_calls(function, _open_call)
        return (_replace_calls(function, take_given) or function) if within is None else rewrite(within)

    return [rewrite(function) for function in functions]


def _open_call(called: ca.Function, arguments: list[ca.MX], but: Collection[int] = ()) -> ca.MX | None:
    """Output of a called graph, expanded; None for other functions, and for those with hashes in `but`."""
    whole = hash(called) in but or not called.is_a("MXFunction")
    return None if whole else called.call(arguments, True, False)[0]


def _replace_calls(
    function: ca.Function, form: Callable[[ca.Function, list[ca.MX]], ca.MX | None], more: list[ca.MX] | None = None
) -> ca.Function | None:
    """Replace calls in a graph whose first argument is its first input; None if nothing is replaced.

    Args:
        function: the graph.
        form: gives an expression for a called function and its arguments, or None to keep the call.
        more: symbols in these expressions; they become additional inputs.
    """
    if not function.is_a("MXFunction"):
        return None
    inputs = function.mx_in()
    outputs = function.call(inputs, True, False)
    # Collect calls and their replacements in order; arguments may contain calls that are replaced already.
    flat, old, new = ca.Function(function.name(), inputs, outputs), list[ca.MX](), list[ca.MX]()
    for k in range(flat.n_instructions()):
        node = flat.instruction_MX(k)
        if flat.instruction_id(k) != ca.OP_CALL or node.dep(0).__hash__() != inputs[0].__hash__():
            continue
        if node.which_function().n_out() == 1:
            arguments = [node.dep(i) for i in range(node.n_dep())]
            changed = form(node.which_function(), ca.graph_substitute(arguments, old, new) if old else arguments)
            if changed is not None:
                new.append(changed)
                old.append(node.get_output(0))
    if not old:
        return None
    # Substitution copies the expressions between calls, so common ones are merged again.
    outputs = ca.cse(ca.graph_substitute(outputs, old, new))
    inputs, names = inputs + (more or []), function.name_in() + [symbol.name() for symbol in more or []]
    return ca.Function(function.name(), inputs, outputs, names, function.name_out())


def _take_sines(function: ca.Function) -> ca.Function | None:
    """Turn an SX function of (q, ...) into one of (sin q, cos q, q, ...).

    None if it has no sines or cosines of entries of q, or several outputs.
    """
    if not function.is_a("SXFunction") or function.n_out() != 1:
        return None
    n, inputs = function.size1_in(0), function.sx_in()
    turns = {ca.OP_SIN: ca.SX.sym("sine", n), ca.OP_COS: ca.SX.sym("cosine", n)}
    work: dict[int, ca.SX] = {}
    # The joint whose position a place of the work array holds, for places that hold one.
    joints: dict[int, int] = {}
    entries: dict[int, ca.SX] = {}
    has_turns = False
    # Evaluate the instructions with symbols instead of sines and cosines of entries of q.
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        into, of = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            entries[into[1]] = work[of[0]]
            continue
        joint = joints.get(of[0]) if code in turns else None
        joints.pop(into[0], None)
        if code == ca.OP_CONST:
            work[into[0]] = ca.SX(function.instruction_constant(k))
        elif code == ca.OP_INPUT:
            work[into[0]] = inputs[of[0]].nz[of[1]]
            if of[0] == 0:
                joints[into[0]] = of[1]
        elif joint is not None:
            work[into[0]], has_turns = turns[code][joint], True
        else:
            work[into[0]] = (ca.SX.unary if len(of) == 1 else ca.SX.binary)(code, *(work[place] for place in of))
    output = ca.SX(function.sparsity_out(0), ca.vertcat(*(entries[k] for k in range(len(entries)))))
    return ca.Function(function.name(), [*turns.values(), *inputs], [output]) if has_turns else None


def render(template: str, values: Mapping[str, Any], package: str = __package__) -> str:
    """Fill in `templates/TEMPLATE.jinja` of a package. It is an error if `values` lacks a name in it."""
    return _environment(package).get_template(f"{template}.jinja").render(values)


def get_source(name: str, package: str = __package__) -> str:
    """Content of a C file in the folder `runtime/` of a package."""
    return (files(package) / "runtime" / name).read_text()


@cache
def _environment(package: str) -> Environment:
    """The Jinja environment of a package's templates.

    Filters: `x | numbers` writes C literals, `x | array` and `x | strings` C initialisers, and `x | code` translates
    Python for NumPy to the template's library.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context  # charts load without it

    # Missing names are errors, and generated text is not HTML.
    environment = Environment(
        loader=PackageLoader(package, "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters |= {"numbers": write_numbers, "array": lambda values: f"{{{write_numbers(values)}}}"}
    # C string literals have single quotes in place of double ones.
    environment.filters["strings"] = lambda words: "{" + ", ".join('"' + w.replace('"', "'") + '"' for w in words) + "}"

    # Translate Python code for NumPy to the library that the template is for.
    def translate(context: Context, text: str) -> str:
        return str(context["library"].translate(text))

    environment.filters["code"] = pass_context(translate)
    return environment


def write_numbers(values: Iterable[Any]) -> str:
    """C literals separated by commas, which C reads as exactly the same numbers; 0 and 1 for truth values."""
    return ", ".join(map(write_number, np.ravel(np.asarray(values)).tolist()))


def write_number(value: float) -> str:
    """A C literal, with a decimal point or exponent only for floats."""
    return str(int(value)) if isinstance(value, int) else _INFINITIES.get(value, repr(float(value)))
