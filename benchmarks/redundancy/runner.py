"""Finding methods and scenarios, running them, and what is kept of a run."""

import importlib
import importlib.util
import json
import logging
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import orthocas as oc
from redundancy.arms import HELD_OUT, SOURCES, TICK, Arm
from redundancy.protocol import Method, Run, Scenario, Stream, Unsuited

FOLDER = Path(__file__).parent
RESULTS, SETTINGS = FOLDER / "results", FOLDER / "settings.json"
SCHEMA = 1  #: of the files in results
FASTER = 1.05  #: than its velocity limit, which a joint may be
PATIENCE = 51  #: ticks that a method may be late with; one that takes longer is stopped, and its row says so
ORDER = (
    "pseudo_inverse",
    "jparse",
    "pink",
    "mink",
    "placo",
    "ssik",
    "operational_space",
    "ompl",
    "charts",
)  #: of the rows


class Missing:
    """A file of methods whose package is not installed."""

    def __init__(self, path: Path, error: ImportError) -> None:
        self.name, self.packages, self.grid = path.stem, (), ({},)
        self.why = f"not installed ({error.name})"

    def __call__(self, arm: Arm, **settings: Any) -> Method:
        """There is none."""
        raise Unsuited(self.why)


def loaded(path: Path) -> ModuleType:
    """A file of methods or scenarios as a module."""
    if path.parent.parent == FOLDER:
        return importlib.import_module(f"redundancy.{path.parent.name}.{path.stem}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def files_of(kind: str) -> list[Path]:
    """The files of a folder."""
    paths = [path for path in (FOLDER / kind).glob("*.py") if path.stem != "__init__"]
    return sorted(paths, key=lambda path: (ORDER.index(path.stem) if path.stem in ORDER else len(ORDER), path.stem))


def methods(more: Iterable[Path] = (), only: Sequence[str] = ()) -> list[Any]:
    """The classes of all methods, or of some by their names, and of files outside."""
    found: list[Any] = []
    for path in (*files_of("methods"), *more):
        try:
            found += loaded(path).METHODS
        except ImportError as error:
            found.append(Missing(path, error))
    unknown = set(only) - {method.name for method in found}
    if unknown:
        raise ValueError(f"unknown methods {sorted(unknown)}, known: {', '.join(method.name for method in found)}")
    return [method for method in found if not only or method.name in only]


def scenarios() -> dict[str, Scenario]:
    """All scenarios, by name."""
    found = [loaded(path).SCENARIO for path in files_of("scenarios")]
    return {scenario.name: scenario for scenario in found}


def settings_of(method: Any) -> dict[str, Any]:
    """What the tuning chose, or else what the documentation says."""
    chosen: dict[str, Any] = json.loads(SETTINGS.read_text())["chosen"] if SETTINGS.exists() else {}
    return dict(chosen.get(method.name, method.grid[0]))


def versions(method: Any) -> dict[str, str]:
    """Of the distributions of a method."""
    found = {}
    for package in method.packages:
        try:
            found[package] = oc.__version__ if package == "orthocas" else version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def followed(arm: Arm, method: Method, stream: Stream) -> Run:
    """Stream targets to a method."""
    method.start(stream.start, stream.targets if stream.known else None)
    path, errors, begin = [], [], time.process_time()
    for k, target in enumerate(stream.targets):
        q = np.array(method.step(target), dtype=float)
        rest = arm.error(q, target.placement) if np.isfinite(q).all() else np.full(6, np.inf)
        path.append(q)
        errors.append((np.linalg.norm(rest[:3]), np.linalg.norm(rest[3:])))
        if time.process_time() - begin > max(k, PATIENCE) * TICK:
            raise Unsuited("slower than the ticks of 10 ms")
    q = np.array(path)
    steps = np.abs(np.diff(np.vstack([stream.start, q]), axis=0))
    return Run(stream, q, np.array(errors), arm.inside(q), bool((steps <= FASTER * TICK * arm.fastest).all()))


def case(scenario: Scenario, arm: Arm, build: Any, seed: int, quick: bool) -> dict[str, Any]:
    """One scenario, arm, method and seed: what is kept of it. `build` is a method of the arm, or why there is none."""
    found: dict[str, Any] = {"arm": arm.name, "seed": seed}
    before = time.process_time()
    try:
        if isinstance(build, Unsuited):
            raise build
        streams = built_streams(scenario.name, arm, seed, quick)
        before = time.process_time()
        runs = [followed(arm, build, stream) for stream in streams]
        ticks = sum(len(run.q) for run in runs)
        score = scenario.judge(arm, runs)
        found |= {"value": _number(score.value), "served": bool(score.served)}
        found |= {"also": _number(score.also)} if scenario.also else {}
        found |= {"us per tick": round(1e6 * (time.process_time() - before) / ticks)}
    except Unsuited as reason:
        found |= {"why": str(reason)}
    except Exception as error:
        logging.getLogger(__name__).warning("%s, %s, %s", scenario.name, arm.name, build, exc_info=error)
        found |= {"why": f"failed: {type(error).__name__}"}
    return found


@cache
def built_streams(name: str, arm: Arm, seed: int, quick: bool) -> list[Stream]:
    """The streams of a scenario, the same for all methods."""
    return scenarios()[name].streams(arm, np.random.default_rng([seed, *name.encode(), *arm.name.encode()]), quick)


def _number(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


def built(method: Any, arm: Arm, settings: Mapping[str, Any]) -> Any:
    """A method of an arm, or why there is none."""
    try:
        return method(arm, **settings)
    except Unsuited as reason:
        return reason
    except Exception as error:
        logging.getLogger(__name__).warning("%s, %s", method.name, arm.name, exc_info=error)
        return Unsuited(f"failed: {type(error).__name__}")


def on_arm(
    name: str,
    mobile: bool,
    names: Sequence[str],
    seeds: Sequence[int],
    more: Sequence[Path],
    quick: bool,
    only: Sequence[str],
) -> list[tuple[str, str, dict[str, Any]]]:
    """All cases of an arm: scenario, method, and what is kept. Methods are built once."""
    warnings.simplefilter("ignore")
    arm, found = Arm(name, mobile), []
    asked = [scenario for scenario in scenarios().values() if scenario.name in names and scenario.mobile == mobile]
    for method in methods(more, only) if asked else ():
        build = built(method, arm, settings_of(method))
        for scenario in asked:
            for seed in seeds:
                found.append((scenario.name, method.name, case(scenario, arm, build, seed, quick)))
    return found


def measured(
    names: Sequence[str],
    arms: Sequence[str] = tuple(SOURCES),
    seeds: Sequence[int] = (0, 1),
    more: Sequence[Path] = (),
    quick: bool = False,
    processes: int = 2,
    only: Sequence[str] = (),
) -> dict[str, dict[str, Any]]:
    """The content of the results' files, by scenario. What other methods, arms and seeds have there is kept.

    Arms that are held out have a folder of their own.
    """
    apart = "held_out" if set(arms) <= set(HELD_OUT) else ""
    tasks = [(name, mobile, names, seeds, more, quick, only) for mobile in (False, True) for name in arms]
    known, cases, content = scenarios(), [], {}
    for found in _in_processes(tasks, processes):
        cases += found
        content = {
            name: _file(known[name], [one for one in cases if one[0] == name], arms, seeds, methods(more, only))
            for name in names
        }
        if not quick:
            save(content, apart)  # what is there so far
    return content


def _in_processes(tasks: Sequence[Any], processes: int) -> Iterator[list[Any]]:
    if processes == 1:
        yield from (on_arm(*task) for task in tasks)
        return
    with ProcessPoolExecutor(processes) as pool:
        for future in as_completed([pool.submit(on_arm, *task) for task in tasks]):
            yield future.result()


def _file(
    scenario: Scenario, cases: Sequence[Any], arms: Sequence[str], seeds: Sequence[int], run: Sequence[Any]
) -> dict[str, Any]:
    rows = {}
    for method in run:
        mine = [kept for _, name, kept in cases if name == method.name]
        mine.sort(key=lambda kept: (list(arms).index(kept["arm"]), kept["seed"]))
        rows[method.name] = {"versions": versions(method), "settings": settings_of(method), "cases": mine}
    return {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "number": scenario.number,
        "also": scenario.also,
        "threads": dict(scenario.threads),
        "seeds": list(seeds),
        "arms": list(arms),
        "methods": rows,
    }


def save(found: Mapping[str, Mapping[str, Any]], apart: str = "") -> None:
    """One file for each scenario, with what others have measured there before; of some arms, in a folder of its own."""
    folder = RESULTS / apart
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in found.items():
        path = folder / f"{name}.json"
        before = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps(_join(before, content), indent=1) + "\n")


def _join(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Results with those of before: of other methods, and of other arms and seeds of the same settings."""
    if before.get("schema") != now["schema"]:
        return dict(now)
    arms = [name for name in (*SOURCES, *HELD_OUT) if name in {*before["arms"], *now["arms"]}]
    rows = dict(before["methods"])
    for name, row in now["methods"].items():
        done = {(case["arm"], case["seed"]) for case in row["cases"]}
        old = rows.get(name, row)
        kept = [case for case in old["cases"] if (case["arm"], case["seed"]) not in done]
        cases = [*row["cases"], *(kept if old["settings"] == row["settings"] else [])]
        rows[name] = {**row, "cases": sorted(cases, key=lambda case: (arms.index(case["arm"]), case["seed"]))}
    return {**now, "arms": arms, "seeds": sorted({*before["seeds"], *now["seeds"]}), "methods": rows}
