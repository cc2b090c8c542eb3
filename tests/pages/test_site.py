"""The documentation site: every public name has a place in the reference, and every page a place in the contents."""

import re
import sys
from importlib import import_module
from os.path import normpath
from pathlib import Path
from types import ModuleType

import pytest
from browser import PROGRAM, browser

import orthocas

DOCS = Path(__file__).parents[2] / "docs"
sys.path.insert(0, str(DOCS / "_ext"))
DIRECTIVE = re.compile(r"^\.\. auto(?:class|function|module):: (orthocas(?:\.\w+)+)$", flags=re.MULTILINE)
FILES = {str(path.relative_to(DOCS).with_suffix("")): path for path in DOCS.rglob("*.md")}
PAGES = {name: path.read_text() for name, path in FILES.items() if not name.startswith("joss/")}  # the paper is no page


def described() -> list[str]:
    return [name for page in PAGES.values() for name in DIRECTIVE.findall(page)]


def contents(page: str) -> set[str]:
    """The pages that the tables of contents of a page name."""
    folder = Path(page).parent
    trees = re.findall(r"```\{toctree\}\n(.*?)```", PAGES[page], flags=re.DOTALL)
    names = [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]
    return {normpath(folder / name) for name in names}


def test_every_public_name_is_in_the_reference_once() -> None:
    found = described()
    assert len(found) == len(set(found)) > 100
    public = {f"orthocas.{name}": getattr(orthocas, name) for name in orthocas.__all__}
    wanted = {part.__name__ if isinstance(part, ModuleType) else name for name, part in public.items()}
    for name in ("codegen", "control", "paths", "robots.obstacles", "simulation", "viewer"):
        package = import_module(f"orthocas.{name}")
        own = {f"{package.__name__}.{name}" for name in package.__all__}
        wanted |= {name for name in own if f"orthocas.{name.split('.')[-1]}" not in wanted}
    assert wanted - set(found) == set()


def test_every_page_is_reached_from_the_first_one() -> None:
    reached, new = set[str](), {"index"}
    while new:
        reached |= new
        new = {name for page in new for name in contents(page)} - reached
    assert reached == set(PAGES)


def test_names_on_the_pages_exist() -> None:
    """Whatever a page calls `oc.name` or `oc.module.name`."""
    used = {name for page in PAGES.values() for name in re.findall(r"\boc\.(\w+(?:\.\w+)?)", page)}
    assert len(used) > 40
    assert [name for name in sorted(used) if not exists(name)] == []


def exists(name: str) -> bool:
    part: object = orthocas
    for word in name.split("."):
        part = getattr(part, word, None)
    return part is not None


def test_formulas_of_docstrings_become_markup() -> None:
    pytest.importorskip("sphinx")
    markup = import_module("plain_formulas").markup
    assert markup("J_x A^-1 J_xi^T = 0") == r"J\ :sub:`x`\  A\ :sup:`-1`\  J\ :sub:`ξ`\ \ :sup:`T`\  = 0"
    assert markup("`xi_1` and lambda1 |dxi_j|, see [AS2023]") == (
        r"``xi_1`` and λ1 \|dξ\ :sub:`j`\ \|, see :doc:`[AS2023] </reference/references>`"
    )


def test_formulas_in_the_text_of_pages_get_indices_and_powers_and_names_do_not() -> None:
    pytest.importorskip("sphinx")
    raised = import_module("plain_formulas").raised

    def shown(text: str) -> str:
        signs = {"subscript": "<{}>", "superscript": "^<{}>"}
        return "".join(signs.get(type(node).__name__, "{}").format(node.astext()) for node in raised(text))

    assert shown("M_φ⁻¹, dξ_j(q), v_x,iᵀ and |e|²_A⁻¹") == "M<φ>⁻¹, dξ<j>(q), v<x,i>ᵀ and |e|²<A⁻¹>"
    assert shown("K^½ZM^½ and J_x^#") == "K^<½>ZM^<½> and J<x>^<#>"
    for name in ("planar_3r_xy", "OUTSIDE_DOMAIN", "task_std_deg", "ros2_control"):
        assert shown(name) == name


LIMITS = {"how-to": 800, "explanation": 1500}  #: words beside code


@pytest.mark.parametrize("name", [name for name in PAGES if name.split("/")[0] in LIMITS])
def test_pages_are_short(name: str) -> None:
    """What to type on one page, why on others; a page that is too long is two."""
    text = re.sub(r"^( *)```.*?^\1```$", "", PAGES[name], flags=re.DOTALL | re.MULTILINE)
    assert len(text.split()) <= LIMITS[name.split("/", maxsplit=1)[0]]


def test_the_navigation_has_about_thirty_pages() -> None:
    """Of two levels; other pages stand below one of these."""
    assert 25 <= len(contents("index")) <= 36


SITE = DOCS.parent / "build" / "docs"
WIDTHS = (360, 600, 760, 860, 920, 1010, 1178, 1440, 1920)  #: of windows [px]; side bars appear in between
#: what ends right of the window, or of its own column, without a bar to scroll it
CUT = """(() => {
  const scrolls = e => e && (/auto|scroll/.test(getComputedStyle(e).overflowX) || scrolls(e.parentElement));
  const cut = e => e.right > innerWidth + 1 || e.left < -1 || e.right > column.right + 1;
  const article = document.querySelector('article'), column = article.closest('.content').getBoundingClientRect();
  const parts = [...article.querySelectorAll('p, li, h1, h2, h3, dt, dd, pre, table, img, .math')];
  const found = parts.filter(e => e.offsetWidth && cut(e.getBoundingClientRect()) && !scrolls(e));
  return found.map(e => e.tagName + ' ' + e.textContent.slice(0, 40));
})()"""


@pytest.mark.nightly
@pytest.mark.skipif(PROGRAM is None, reason="no chromium: apt-get install chromium")
@pytest.mark.skipif(not (SITE / "genindex.html").exists(), reason="no site: make docs")
def test_no_page_is_cut_at_any_width(tmp_path: Path) -> None:
    cut = {}
    with browser(tmp_path) as page:
        for name in PAGES:
            page.open((SITE / f"{name}.html").as_uri())
            page.wait("document.readyState === 'complete' && !!document.querySelector('article')")
            for width in WIDTHS:
                size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
                page.call("Emulation.setDeviceMetricsOverride", **size)
                if found := page.value(CUT):
                    cut[name, width] = found[0]
    assert cut == {}
