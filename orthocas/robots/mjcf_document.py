"""An MJCF file as one tree, with included files inserted and default classes applied."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

from orthocas.errors import RobotError
from orthocas.robots.mjcf_schema import ACTUATORS, DEFAULTS, KNOWN, ORIENTATIONS, SECTIONS
from orthocas.robots.xml import MOST_DEPTH, MOST_ELEMENTS, Attributes, read_xml

MAIN = "main"  #: the default class of elements that name none

_Settings = dict[str, dict[str, str]]  # attributes by element


class Document:
    """The tree of an MJCF file.

    Includes and default classes follow the MuJoCo reference. Paths of included files are relative to the folder of the
    main file, and each file may be included once. A class inherits from its parent class. An element's own attributes
    take precedence.

    Raises:
        RobotError: if a file cannot be read, or an include or default class is invalid.
    """

    def __init__(self, path: str | Path) -> None:
        self._main = Path(path)
        self._files: dict[Element, str] = {}  # the file of each element
        self._included = {self._main.resolve()}
        self._classes: dict[str, _Settings] = {MAIN: {}}
        self._root = self._read(self._main, "mujoco", 1)
        self._require_names(self._root, SECTIONS)
        for section in self.sections("default"):
            name = section.get("class", MAIN)
            if name != MAIN:
                raise self.label(section).error(f"has class '{name}', expected the outermost class to be '{MAIN}'")
            self._define(section, MAIN, self._classes[MAIN])

    def sections(self, tag: str) -> Iterator[Element]:
        """The elements with a tag directly below the root. A file may have several."""
        return (element for element in self._root if element.tag == tag)

    def settings(self, path: str) -> Attributes:
        """The attributes of a global element such as compiler or option/flag. Later elements override earlier ones."""
        found = self._root.findall(path)
        values = {name: value for element in found for name, value in _own(element, self.label(element)).items()}
        return Attributes(str(self._main), f"<{path.rsplit('/', maxsplit=1)[-1]}>", values)

    def label(self, element: Element, body: str | None = None) -> Attributes:
        """An element's own attributes, with the element's name for messages."""
        shown = [f" {key}='{element.attrib[key][:80]}'" for key in ("name", "class") if key in element.attrib]
        inside = f" of body '{body[:80]}'" if body else ""
        return Attributes(self._files[element], f"<{element.tag}{''.join(shown[:1])}>{inside}", element.attrib)

    def attributes(self, element: Element, childclass: str = MAIN, body: str | None = None) -> Attributes:
        """An element's attributes, with those of its default class filled in: the class it names, or childclass.

        Raises:
            RobotError: if the class does not exist, or an attribute is unknown.
        """
        label = self.label(element, body)
        name = self.known_class(element.get("class", childclass), label)
        values = _over(self._classes[name].get(_kind(element.tag), {}), _own(element, label))
        return Attributes(label.file, label.element, values)

    def known_class(self, name: str, label: Attributes) -> str:
        """Check the name of a default class.

        Raises:
            RobotError: if there is no such class.
        """
        if name not in self._classes:
            raise label.error(f"is of class '{name}', known: {', '.join(self._classes)}")
        return name

    def _require_names(self, parent: Element, known: Collection[str]) -> None:
        for element in parent:
            if element.tag not in known:
                raise self.label(element).error(f"is an unknown element in <{parent.tag}>")

    def _read(self, path: Path, tag: str | None, depth: int) -> Element:
        root = read_xml(path, "MJCF", tag)
        self._files |= dict.fromkeys(root.iter(), str(path))
        if len(self._files) > MOST_ELEMENTS:
            raise RobotError(f"{self._main} includes files with more than {MOST_ELEMENTS} elements in all")
        self._expand(root, depth)
        return root

    def _expand(self, parent: Element, depth: int) -> None:
        """Replace each <include> by the elements of its file."""
        if depth > MOST_DEPTH:
            raise RobotError(f"elements of {self._main} and its included files nest more than {MOST_DEPTH} deep")
        children: list[Element] = []
        for child in parent:
            if child.tag == "include":
                children += self._include(child, depth)
            else:
                self._expand(child, depth + 1)
                children.append(child)
        parent[:] = children

    def _include(self, element: Element, depth: int) -> Element:
        label = self.label(element)
        path = self._main.parent / label.text("file")
        if path.resolve() in self._included:
            raise label.error(f"includes {path} a second time, expected each file once")
        self._included.add(path.resolve())
        return self._read(path, None, depth + 1)

    def _define(self, section: Element, name: str, inherited: _Settings) -> None:
        """Add a default class, then the classes inside it."""
        self._require_names(section, DEFAULTS)
        settings = {tag: dict(values) for tag, values in inherited.items()}
        for child in section:
            if child.tag != "default":
                kind = _kind(child.tag)
                settings[kind] = _over(settings.get(kind, {}), _own(child, self.label(child)))
        self._classes[name] = settings
        for child in section.findall("default"):
            inner = self.label(child).text("class")
            if inner in self._classes:
                raise self.label(child).error(f"defines class '{inner}' a second time")
            self._define(child, inner, settings)


def _kind(tag: str) -> str:
    """The name under which a default class keeps the settings of an element."""
    return "general" if tag in ACTUATORS else tag


def _own(element: Element, label: Attributes) -> dict[str, str]:
    """An element's attributes, after a check that all are known."""
    for name in element.attrib:
        if name not in KNOWN.get(element.tag, element.attrib):
            raise label.error(f"has an unknown attribute '{name}'")
    if sum(name in element.attrib for name in ORIENTATIONS) > 1:
        raise label.error(f"has several orientations, expected one of {', '.join(ORIENTATIONS)}")
    return dict(element.attrib)


def _over(inherited: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Merge own and inherited attributes. An orientation replaces any other; a short size keeps further numbers."""
    if any(name in own for name in ORIENTATIONS):
        inherited = {name: value for name, value in inherited.items() if name not in ORIENTATIONS}
    merged = {**inherited, **own}
    if "size" in inherited and "size" in own:
        sizes = own["size"].split()
        merged["size"] = " ".join(sizes + inherited["size"].split()[len(sizes) :])
    return merged
