"""Where the parts of a page come to stand on paper: Chromium's PDF, read by the frames of links.

A link without a mark is laid over each part. Chromium writes the frame of every link into the PDF,
once for each sheet that its part reaches, so that no text has to be read out of it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

POINTS: Final = 72 / 25.4
"""Points in a millimetre."""
HERE: Final = "https://part.invalid/"

_OVERLAY: Final = """([selector, here]) => {
  const parts = [...document.querySelectorAll(selector)].filter((e) => e.getClientRects().length);
  return parts.map((e, k) => {
    const held = e.tagName === 'TR' ? e.cells[0] : e;
    held.style.position = 'relative';
    const link = document.createElement('a');
    link.className = 'frame-of-a-part';
    link.href = here + k;
    link.style.cssText = 'position:absolute;inset:0';
    held.append(link);
    const tag = e.parentNode.tagName === 'THEAD' ? 'thead' : e.tagName.toLowerCase();
    const name = tag + (e.className ? '.' + e.className : '');
    return [name, e.textContent.trim().slice(0, 200)];
  });
}"""
_AWAY: Final = "() => document.querySelectorAll('.frame-of-a-part').forEach((e) => e.remove())"


@dataclass(frozen=True)
class Part:
    """A part of the page on paper.

    Attributes
    ----------
    kind, said : str
        Tag and class, "thead" for the row at the head of a table; how its text begins.
    frames : tuple of (sheet, left, top, right, bottom)
        One for each sheet that it reaches; millimetres from the sheet's upper left corner.
    """

    kind: str
    said: str
    frames: tuple[tuple[int, float, float, float, float], ...]

    @property
    def first(self) -> int:
        """The sheet on which it begins."""
        return min(f[0] for f in self.frames)

    @property
    def last(self) -> int:
        """The sheet on which it ends."""
        return max(f[0] for f in self.frames)


def printed(page: Any, **options: Any) -> bytes:
    """The page as a PDF; options as Chromium's own."""
    made = page.pdf(print_background=True, **options)
    assert isinstance(made, bytes)
    return made


def parts_on_paper(page: Any, selector: str, **options: Any) -> list[Part]:
    """Every visible part, in the page's order, with its frames on the sheets."""
    said = page.evaluate(_OVERLAY, [selector, HERE])
    try:
        frames = _frames(printed(page, **options))
    finally:
        page.evaluate(_AWAY)
    return [Part(*s, tuple(frames.get(k, ()))) for k, s in enumerate(said)]


def sheets(made: bytes) -> int:
    """Number of sheets of a PDF of Chromium."""
    return len(_pages(_objects(made)))


def _objects(made: bytes) -> dict[int, bytes]:
    """Objects by their number, streams left out; Chromium packs streams alone."""
    bare = re.sub(rb"stream\r?\n.*?endstream", b"", made, flags=re.DOTALL)
    found = re.finditer(rb"(\d+) 0 obj\b(.*?)endobj", bare, re.DOTALL)
    return {int(m[1]): m[2] for m in found}


def _pages(objects: dict[int, bytes]) -> Sequence[bytes]:
    """The sheets in their order, from the tree of pages."""
    root = next(b for b in objects.values() if b"/Type /Catalog" in b)

    def below(number: int) -> list[bytes]:
        body = objects[number]
        kids = re.search(rb"/Kids\s*\[(.*?)\]", body, re.DOTALL)
        if kids is None:
            return [body]
        return [p for n in re.findall(rb"(\d+) 0 R", kids[1]) for p in below(int(n))]

    top = re.search(rb"/Pages (\d+) 0 R", root)
    assert top is not None
    return below(int(top[1]))


def _frames(made: bytes) -> dict[int, list[tuple[int, float, float, float, float]]]:
    objects = _objects(made)
    out: dict[int, list[tuple[int, float, float, float, float]]] = {}
    for sheet, body in enumerate(_pages(objects), 1):
        box = re.search(rb"/MediaBox\s*\[\s*(\S+) (\S+) (\S+) (\S+?)\s*\]", body)
        assert box is not None
        height = float(box[4])
        listed = re.search(rb"/Annots\s*\[(.*?)\]", body, re.DOTALL)
        for number in re.findall(rb"(\d+) 0 R", listed[1]) if listed else ():
            link = objects[int(number)]
            part = re.search(re.escape(HERE).encode() + rb"(\d+)", link)
            rect = re.search(rb"/Rect\s*\[\s*(\S+) (\S+) (\S+) (\S+?)\s*\]", link)
            if part is None or rect is None:
                continue
            left, low, right, high = (float(v) for v in rect.groups())
            frame = (left, height - high, right, height - low)
            out.setdefault(int(part[1]), []).append(
                (sheet, *(v / POINTS for v in frame))  # type: ignore[arg-type]
            )
    return out
