"""An effect added to the text of a joint file: everything else in it stays, remarks too."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from identification.data.joint_file import Joint
from identification.data.own_effects import TABLE, remembered
from identification.data.plain_text import from_toml, tables_text, toml_value
from identification.data.typed_laws import LAWS, law_lines
from identification.errors import InputError

_LIST: Final = re.compile(r"^[ \t]*effects[ \t]*=[ \t]*(?=\[)", re.MULTILINE)
LONGEST: Final = 4000
"""Characters in which the end of a list of effects is looked for; the whole library takes 800."""
_HEAD: Final = re.compile(r"^[ \t]*\[[ \t]*joint[ \t]*\][^\n]*\n", re.MULTILINE)


def with_effects(text: str, joint: Joint) -> str:
    """The text of a joint file with the effects and typed laws of a joint that was read from it.

    Parameters
    ----------
    text : str
        Valid TOML, from which the joint comes.
    joint : Joint
        With further effects, and the laws and the files of users that they need.

    Returns
    -------
    str
        The same tables and values but for the effects, their laws and their files. Remarks and
        layout stay, unless the list of effects cannot be told from a text inside the file; then
        all tables are written anew.
    """
    source = joint.source or joint.name
    wanted = from_toml(text, source)
    wanted["joint"] = {**wanted["joint"], "effects": list(joint.effects)}
    more = {
        name: from_toml("\n".join(lines), source)[name]
        for name, lines in ((LAWS, law_lines(joint.laws)), (TABLE, remembered(joint.effects)))
        if lines
    }
    wanted.update(more)
    for edited in _edits(text, wanted):
        try:
            if from_toml(edited, source) == wanted:
                return edited
        except InputError:
            continue
    return tables_text(wanted)


def _edits(text: str, wanted: Mapping[str, Any]) -> Iterator[str]:
    """Texts in which the list of effects may be the right one."""
    text = text if text.endswith("\n") else text + "\n"
    effects = toml_value(wanted["joint"]["effects"])
    new = {n: wanted[n] for n in (LAWS, TABLE) if n in wanted and f"[{n}]" not in text}
    end = f"\n{tables_text(new)}" if new else ""
    for found in _LIST.finditer(text):
        before, after = text[: found.end()], text[found.end() :]
        for close in re.finditer(r"\]", after[:LONGEST]):
            yield before + effects + after[close.end() :] + end
    for found in _HEAD.finditer(text):
        yield text[: found.end()] + f"effects = {effects}\n" + text[found.end() :] + end


__all__ = ["with_effects"]
