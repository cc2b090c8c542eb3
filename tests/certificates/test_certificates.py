"""Certificates are kept, checked, resumed and void when anything changes; the command."""

import json
import warnings
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certified_charts import certified, chart
from chart_files import header_of, resealed
from public_objects import planar
from typer.testing import CliRunner

import orthocas as oc
from orthocas import problems
from orthocas.certificates import check_certificate
from orthocas.charts.certificate import OPEN, PROVED, Certificate, Subdivision
from orthocas.charts.coordinates import Coordinates
from orthocas.cli.commands import build_app
from orthocas.errors import CertifyError, ChartFileError, Interrupted, InvalidValueError, SchedulerError
from orthocas.tools.progress import Progress


@pytest.mark.slow
def test_a_certificate_is_void_when_one_coefficient_changes(tmp_path: Path) -> None:
    known = replace(chart(), certificate=certified())
    coordinates = known.coordinates
    assert isinstance(coordinates, Coordinates)
    theta = coordinates.theta.copy()
    theta[3] = np.nextafter(theta[3], np.inf)
    with pytest.raises(CertifyError, match="void"):
        replace(known, coordinates=replace(coordinates, theta=theta))
    changed = replace(known, coordinates=replace(coordinates, theta=theta), certificate=None)
    with pytest.raises(CertifyError, match="void"):
        check_certificate(changed, certified())
    replace(known, notes={"new": "note"}).save(tmp_path / "a.chart")  # notes are no part of the proof
    assert oc.load(tmp_path / "a.chart").certificate is not None


@pytest.mark.slow
def test_files_keep_certificates(tmp_path: Path) -> None:
    replace(chart(), certificate=certified()).save(tmp_path / "a.chart")
    again = oc.load(tmp_path / "a.chart")
    assert again.certificate is not None
    assert again.certificate.facts() == certified().facts()
    assert check_certificate(again)


@pytest.mark.slow
def test_a_forged_certificate_does_not_hold() -> None:
    known = certified()
    whole = Subdivision(known.regular.low, known.regular.high, np.array([PROVED], dtype=np.uint8))
    wide = chart(0.4)
    honest = certified(0.4)
    forged = replace(honest, regular=Subdivision(honest.regular.low, honest.regular.high, whole.codes)).seal()
    assert not check_certificate(wide, forged)
    other = replace(honest, regular=known.regular).seal()
    with pytest.raises(CertifyError, match="another domain"):
        check_certificate(wide, other)
    with pytest.raises(CertifyError, match="method"):
        check_certificate(wide, replace(honest, method="guess/1").seal())
    assert not check_certificate(wide, replace(honest, conditioning=0.99).seal())


@pytest.mark.parametrize(
    "change",
    [
        {"boxes": 7},
        {"seconds": 1.0},
        {"bound": 0.1},
        {"conditioning": 0.1},
        {"least_singular_value": 0.2},
        {"fold": ((0.0,) * 7, (0.1,) * 7)},
        {"injective": None},
        {"digest": ""},
        {"digest": "0" * 64},
    ],
    ids=str,
)
def test_a_change_of_any_number_is_seen(change: dict[str, Any]) -> None:
    changed = replace(certified(), **change)
    with pytest.raises(CertifyError, match="changed since|no digest"):
        check_certificate(chart(), changed)
    if "digest" not in change:
        with pytest.raises(CertifyError, match="changed since"):
            replace(chart(), certificate=changed)


def test_what_is_printed_is_computed_again() -> None:
    """With a digest that fits: it protects against accidents, and the check against the rest."""
    known, honest = chart(), certified()
    centre = tuple(known.problem.domain.centre)
    assert not check_certificate(known, replace(honest, fold=(centre, centre)).seal())
    with pytest.raises(CertifyError, match="excludes singular values up to 0.3, the domain 0"):
        check_certificate(known, replace(honest, least_singular_value=0.3).seal())
    box = honest.injective
    assert box is not None
    shifted = replace(box, low=box.low + 0.01, high=box.high + 0.01)
    assert not check_certificate(known, replace(honest, injective=shifted).seal())


def test_a_bound_under_another_metric_is_refused() -> None:
    linear = oc.fit(planar(), oc.Linear()).chart
    found = oc.certify(linear)
    with pytest.raises(CertifyError, match="bound is 0.1 with metric inertia"):
        check_certificate(linear, replace(found, bound=0.1).seal())


def test_a_fold_is_checked_at_its_two_points() -> None:
    folding = oc.fit(planar(), oc.Linear()).chart
    found = oc.certify(folding)
    assert len(found.fold) == 2
    assert check_certificate(folding, found)
    assert not check_certificate(folding, replace(found, fold=found.fold[:1] * 2).seal())
    domain = folding.problem.domain
    outside = tuple(domain.centre + 3 * (np.array(found.fold[1]) - domain.centre))
    assert not check_certificate(folding, replace(found, fold=(found.fold[0], outside)).seal())


@pytest.mark.parametrize("codes", [[0], [0, PROVED], [PROVED, PROVED], [7, PROVED, PROVED], []])
def test_bytes_that_are_no_tree_are_refused(codes: list[int]) -> None:
    with pytest.raises(InvalidValueError, match="codes"):
        Subdivision(np.zeros(2), np.ones(2), np.array(codes, dtype=np.uint8))


def test_parts_cover_the_box_exactly() -> None:
    parts = certified().regular
    low, high = parts.leaves(PROVED)
    assert ((high - low) / (parts.high - parts.low)).prod(axis=1).sum() == pytest.approx(1, abs=1e-12)
    tree = Subdivision(np.zeros(2), np.ones(2), np.array([0, PROVED, 1, OPEN, PROVED], dtype=np.uint8))
    assert tree.share == 0.75
    assert tree.leaves(OPEN)[0].tolist() == [[0.5, 0.0]]
    assert tree.leaves(OPEN)[1].tolist() == [[1.0, 0.5]]


@pytest.mark.slow
def test_an_unfinished_proof_is_resumed() -> None:
    wide = chart()
    begun = oc.certify(wide, time_limit=0)
    assert not begun.proved
    assert begun.regular.open_count > 0
    assert oc.certify(wide, resume=begun).proved
    with pytest.raises(CertifyError, match="resume"):
        oc.certify(wide, 0.1, resume=begun)


@pytest.mark.slow
def test_ctrl_c_returns_what_is_proved_so_far() -> None:
    def stop(progress: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        oc.certify(chart(), monitor=stop)
    result = stopped.value.result
    assert isinstance(result, Certificate)
    assert oc.certify(chart(), resume=result).proved


def test_an_executor_finds_the_same_parts() -> None:
    with ThreadPoolExecutor(2) as executor:
        shared = oc.certify(chart(), executor=executor)
        assert check_certificate(chart(), shared, executor=executor)
    assert shared.regular.codes.tolist() == certified().regular.codes.tolist()


class Dying(ThreadPoolExecutor):
    """An executor whose first calls end as if their processes had died."""

    def __init__(self, deaths: int) -> None:
        super().__init__(1)
        self.deaths = deaths

    def submit(self, *arguments: Any, **named: Any) -> Future[Any]:
        if not self.deaths:
            return super().submit(*arguments, **named)
        self.deaths -= 1
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor("a process died"))
        return future


@pytest.mark.slow
def test_boxes_of_processes_that_died_are_judged_again() -> None:
    with Dying(2) as executor:
        shared = oc.certify(chart(), executor=executor)
        assert executor.deaths == 0
        executor.deaths = 2
        assert check_certificate(chart(), shared, executor=executor)
        assert executor.deaths == 0
    assert shared.regular.codes.tolist() == certified().regular.codes.tolist()


@pytest.mark.slow
def test_boxes_that_processes_die_over_stay_unproved(caplog: pytest.LogCaptureFixture) -> None:
    with Dying(100) as executor:
        found = oc.certify(chart(), executor=executor)
        with pytest.raises(CertifyError, match="one of its processes died"):
            check_certificate(chart(), certified(), executor=executor)
    assert (found.proved, found.regular.open_count > 0) == (False, True)
    assert len(caplog.messages) == 1
    assert "worker processes died over them" in caplog.text
    assert oc.certify(chart(), resume=found).proved


def command(*words: Any) -> Any:
    return CliRunner().invoke(build_app(list(map(str, words))), [str(word) for word in words])


@pytest.mark.slow
def test_the_command_certifies_checks_and_shows(tmp_path: Path) -> None:
    path = tmp_path / "a.chart"
    chart().save(path)
    done = command("certify", path, "--json")
    assert done.exit_code == 0
    found = json.loads(done.stdout)
    assert found["proved"] is True
    assert found["share"] == 1
    assert {"bound", "boxes", "seconds", "conditioning"} <= found.keys()
    assert command("certify", path, "--check").exit_code == 0
    assert "no fold everywhere" in command("certify", path, "--check").stdout
    assert json.loads(command("info", path, "--json").stdout)["certificate"]["proved"] is True
    oc.generate_c(oc.load(path), tmp_path / "c", name="arm")
    assert "no fold everywhere on the domain (taylor-3/2" in (tmp_path / "c" / "arm.h").read_text()


@pytest.mark.slow
def test_the_command_says_first_what_is_not_proved(tmp_path: Path) -> None:
    """Also for a check: a partial proof that holds is no proof, and no share of it is 100 %."""
    path = tmp_path / "a.chart"
    chart().save(path)
    begun = command("certify", path, "--seconds", 0)
    assert begun.exit_code == 1
    assert begun.stdout.startswith("certificate   not proved, ")
    checked = command("certify", path, "--check")
    assert checked.exit_code == 1
    assert "holds for the part that is proved" in checked.stdout
    assert "100" not in checked.stdout.split("method")[0].replace("1000", "")
    known = oc.load(path).certificate
    assert known is not None
    nearly = replace(known, regular=almost_whole(known.regular)).seal()
    assert nearly.share > 1 - 1e-12
    assert "no fold on 99.9999% of the domain" in nearly.heading


def almost_whole(tree: Subdivision) -> Subdivision:
    """A box that is proved but for one part, which is 2^-50 of it."""
    codes = [byte for k in range(50) for byte in (k % tree.n, PROVED)]
    return Subdivision(tree.low, tree.high, np.array([*codes, OPEN], dtype=np.uint8))


def test_numbers_that_no_check_covers_are_left_out_of_certificates(tmp_path: Path) -> None:
    """Older files count parts that were given up: read with their digest, refused if that does not cover the count."""
    known = replace(chart(), certificate=certified())
    path = tmp_path / "a.chart"
    for count, honest in ((7, True), (8, False)):
        known.save(path)
        header: Any = header_of(path)
        header["certificate"] |= {"dead": count, "digest": certified()._compute_digest(7)}
        resealed(path, header)
        if honest:
            assert "dead" not in oc.load(path).certificate.as_dict()  # type: ignore[union-attr]
            assert check_certificate(oc.load(path))
        else:
            with pytest.raises(ChartFileError, match="void"):
                oc.load(path)


@pytest.mark.slow
def test_progress_is_of_what_is_left() -> None:
    """Where folds are kept out, the volume is soon proved and most boxes are left: it is no measure of the work."""
    known = problems.get("planar_3r_xy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        box = oc.Box([0.0, 1.0, 1.0], [3.0, 1.8, 1.8])
        wide = oc.fit_wide(known.robot, known.task, box, parametrisation=oc.Polynomial(3), samples=2000).chart
    reports: list[Progress] = []

    def stop(progress: Progress) -> None:
        reports.append(progress)
        if len(reports) > 20:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        oc.certify(wide, monitor=stop)
    certificate = stopped.value.result
    assert certificate.share > 0.5
    assert reports[-1].fraction == pytest.approx(certificate.boxes / 1e6, abs=1e-3)
    assert f"{certificate.boxes:,} boxes, {certificate.regular.open_count:,} open" in reports[-1].detail


def test_the_command_fails_for_a_chart_that_folds(tmp_path: Path) -> None:
    path = tmp_path / "a.chart"
    oc.fit(planar(), oc.Linear()).chart.save(path)
    done = command("certify", path)
    assert done.exit_code == 1
    assert "refuted, the chart folds" in done.stdout


def test_a_damaged_certificate_is_a_damaged_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = replace(chart(), certificate=certified())
    monkeypatch.setitem(certified().regular.__dict__, "codes", np.array([3, PROVED], dtype=np.uint8))
    known.save(tmp_path / "a.chart")
    with pytest.raises(ChartFileError, match="codes"):
        oc.load(tmp_path / "a.chart")


def test_dask_shares_the_work() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client,
        client.get_executor(pure=False) as executor,
    ):
        assert oc.certify(chart(), executor=executor).regular.codes.tolist() == certified().regular.codes.tolist()


def test_the_command_names_a_missing_scheduler(tmp_path: Path) -> None:
    chart().save(tmp_path / "a.chart")
    done = command("certify", tmp_path / "a.chart", "--workers", "tcp://127.0.0.1:1")
    assert done.exit_code != 0
    assert isinstance(done.exception, SchedulerError)
