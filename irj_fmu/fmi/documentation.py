"""What stands beside the model in an FMU: documentation/index.html, licences, icon.

Everything is made of the finished modelDescription.xml, of FMI 2.0 as of 3.0, and of notes that
the builder of the model adds. The same description gives the same bytes.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final, final
from xml.etree.ElementTree import Element, SubElement, fromstring

from irj_fmu.fmi.model_description import COPYRIGHT, to_bytes

SIZE: Final = 64
"""Edge of the icon [pixels]."""
_GROUPS: Final = (
    ("input", "Inputs"),
    ("output", "Outputs"),
    ("parameter", "Parameters"),
    ("structuralParameter", "Structural parameters"),
    ("local", "States and other local variables"),
)
_STYLE: Final = (
    "body{font:15px/1.45 sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .5em;"
    "text-align:left;vertical-align:top}pre{background:#f4f4f4;padding:.7em;overflow:auto}"
)
_MIT: Final = """\
{copyright}

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
associated documentation files (the "Software"), to deal in the Software without restriction,
including without limitation the rights to use, copy, modify, merge, publish, distribute,
sublicense, and/or sell copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or
substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT
NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND
NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM,
DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT
OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""


@final
@dataclass(frozen=True)
class Note:
    """A section of the documentation.

    Attributes
    ----------
    title : str
    text : str
        Paragraphs, a blank line between two.
    verbatim : bool
        True: one block of text as it stands, such as equations.
    """

    title: str
    text: str
    verbatim: bool = False


def beside(
    description: bytes,
    notes: Sequence[Note] = (),
    inside: Mapping[str, str] | None = None,
    terminals: Mapping[str, Mapping[str, str]] | None = None,
) -> dict[str, bytes]:
    """Files that go into the FMU with its model.

    Parameters
    ----------
    description : bytes
        modelDescription.xml, FMI 2.0 or 3.0.
    notes : sequence of Note
        Sections beside the tables of the variables: equations, faults, limits.
    inside : mapping of str to str, optional
        Text of the licence of each other work that the FMU holds, by its name.
    terminals : mapping of str to mapping, optional
        FMI 3.0: variable by member of each terminal. Members of the same name go together.

    Returns
    -------
    dict of str to bytes
        Name in the archive to content, where the version of FMI wants it.
    """
    root = fromstring(description)
    licences = {"license.txt": _MIT.format(copyright=COPYRIGHT)}
    for name, text in sorted((inside or {}).items()):
        licences[f"{name}.txt"] = text
    found = {f"documentation/licenses/{name}": text.encode() for name, text in licences.items()}
    found["documentation/index.html"] = _page(root, notes, sorted(licences)).encode()
    if root.get("fmiVersion", "").startswith("3"):
        found["terminalsAndIcons/icon.png"] = icon()
        found["terminalsAndIcons/terminalsAndIcons.xml"] = to_bytes(_icons(terminals or {}))
    else:
        found["model.png"] = icon()
    return found


def _icons(terminals: Mapping[str, Mapping[str, str]]) -> Element:
    root = Element("fmiTerminalsAndIcons", {"fmiVersion": "3.0"})
    graphic = SubElement(root, "GraphicalRepresentation")
    SubElement(
        graphic,
        "CoordinateSystem",
        {
            "x1": "-100",
            "y1": "-100",
            "x2": "100",
            "y2": "100",
            "suggestedScalingFactorTo_mm": "0.1",
        },
    )
    SubElement(graphic, "Icon", {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"})
    if terminals:
        group = SubElement(root, "Terminals")
        for name, members in terminals.items():
            terminal = SubElement(group, "Terminal", {"name": name, "matchingRule": "bus"})
            for member, variable in members.items():
                SubElement(
                    terminal,
                    "TerminalMemberVariable",
                    {"variableName": variable, "memberName": member, "variableKind": "signal"},
                )
    return root


# --- the page -------------------------------------------------------------------------------------


def _page(root: Element, notes: Sequence[Note], licences: Sequence[str]) -> str:
    name = escape(root.get("modelName", ""))
    parts = [f"<h1>{name}</h1>", f"<p>{escape(root.get('description', ''))}</p>"]
    parts.append(_table(("what", "value"), _facts(root)))
    for note in notes:
        parts.append(f"<h2>{escape(note.title)}</h2>")
        if note.verbatim:
            parts.append(f"<pre>{escape(note.text.strip())}</pre>")
        else:
            parts += [f"<p>{escape(p)}</p>" for p in note.text.split("\n\n")]
    variables = [_variable(v) for v in root.iterfind("ModelVariables/*")]
    for causality, title in _GROUPS:
        rows = [row for kind, row in variables if kind == causality]
        if rows:
            parts.append(f"<h2>{title}</h2>")
            parts.append(
                _table(("name", "type", "unit", "start", "min", "max", "meaning", "change"), rows)
            )
    links = ", ".join(f'<a href="licenses/{escape(n)}">{escape(n)}</a>' for n in licences)
    parts.append(f"<h2>Licences</h2>\n<p>{links}</p>")
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f"<title>{name}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _facts(root: Element) -> list[tuple[str, ...]]:
    """What the head of the description says."""
    kinds = {
        "ModelExchange": "model exchange",
        "CoSimulation": "co-simulation",
        "ScheduledExecution": "scheduled execution",
    }
    found = [text for tag, text in kinds.items() if root.find(tag) is not None]
    rows: list[tuple[str, ...]] = [
        ("interface", f"FMI {root.get('fmiVersion')}, {' and '.join(found)}")
    ]
    titles = {
        "version": "version",
        "author": "author",
        "license": "licence",
        "generationTool": "made with",
        "guid": "GUID",
        "instantiationToken": "instantiation token",
    }
    rows += [(title, root.attrib[key]) for key, title in titles.items() if key in root.attrib]
    experiment = root.find("DefaultExperiment")
    experiment_titles = {
        "stopTime": "length of the default experiment [s]",
        "stepSize": "step [s]",
        "tolerance": "relative tolerance",
    }
    if experiment is not None:
        rows += [
            (t, experiment.attrib[k])
            for k, t in experiment_titles.items()
            if k in experiment.attrib
        ]
    return rows


def _variable(node: Element) -> tuple[str, tuple[str, ...]]:
    """Causality and row of one variable."""
    kind = node
    if node.tag == "ScalarVariable":  # FMI 2.0 keeps type and value in an element of their own
        kind = next(iter(node))
    sizes = [d.get("start", "n") for d in node.iterfind("Dimension")]
    shape = f"[{', '.join(sizes)}]" if sizes else ""
    about = {**kind.attrib, **node.attrib}
    keys = ("unit", "start", "min", "max", "description", "variability")
    return about.get("causality", "local"), (
        about["name"],
        f"{kind.tag}{shape}",
        *(about.get(key, "") for key in keys),
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows]
    return "\n".join(["<table>", f"<tr>{top}</tr>", *(f"<tr>{r}</tr>" for r in lines), "</table>"])


# --- the icon -------------------------------------------------------------------------------------


def icon() -> bytes:
    """A geared joint as a PNG of `SIZE` pixels: a housing, a shaft and a link."""
    rows = b"".join(
        b"\0" + bytes(b for x in range(SIZE) for b in _pixel(x, y)) for y in range(SIZE)
    )
    head = struct.pack(">2I", SIZE, SIZE) + bytes((8, 6, 0, 0, 0))  # 8 bits, with opacity
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )


def _pixel(x: int, y: int) -> tuple[int, int, int, int]:
    """Red, green, blue and opacity."""
    far = (x - 20) ** 2 + (y - 40) ** 2
    end = (x - 52) ** 2 + (y - 14) ** 2
    if far <= 5**2 or end <= 3**2:
        return 255, 255, 255, 255
    if far <= 16**2:
        return 38, 84, 124, 255
    # the link lies along the line from the housing's centre to its end
    beside_line = abs(26 * (x - 20) + 32 * (y - 40))
    along = 32 * (x - 20) - 26 * (y - 40)
    length = 32**2 + 26**2
    if end <= 8**2 or (0 <= along <= length and beside_line**2 <= 36 * length):
        return 239, 131, 84, 255
    return 0, 0, 0, 0


def licence_of(package: str) -> str:
    """Text of the licence that an installed package brings, or the name of its licence."""
    from importlib.metadata import distribution

    found = distribution(package)
    for path in found.files or ():
        if path.name.upper().startswith("LICEN") and "dist-info" in path.as_posix():
            return path.read_text(encoding="utf-8")
    about = found.metadata.json
    return f"{package}: {about.get('license_expression') or about.get('license') or 'not stated'}\n"


__all__ = ["SIZE", "Note", "beside", "icon", "licence_of"]
