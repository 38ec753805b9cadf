"""A law of the user's own, typed in one line: fitted to what the current model leaves, and kept in
the joint file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

from casadi_models.text.typed_law import LawError, TypedLaw, derived_key, register
from identification.data.joint_edit import with_effects
from identification.data.joint_file import Joint
from identification.errors import InputError
from workbench.page.jobs.place import Change, Place
from workbench.page.session import State

LONGEST: Final = 500
"""Characters of a law or of its parameters: one line."""


def typed(body: Mapping[str, Any], kind: str) -> TypedLaw:
    """The law in a request: ``law``, ``on`` (a place) and ``parameters``, which commas divide.

    Raises
    ------
    InputError
        It is empty or too long.
    """
    text, place, given = (str(body.get(k, "")).strip() for k in ("law", "on", "parameters"))
    if not text or not place or not given:
        raise InputError(
            'law: give the law, as c*tanh(v/w), where it acts, and its parameters, as "c=0..10 '
            'N.m, w=0.01..1 rad/s"'
        )
    if max(len(text), len(given)) > LONGEST:
        raise InputError(f"law: is longer than {LONGEST} characters; declare it in a file")
    parameters = tuple(p.strip() for p in re.split(r"[,;]", given) if p.strip())
    return TypedLaw(derived_key(text, (place,), parameters), text, (place,), parameters, kind)


def tried(live: Place, body: Mapping[str, Any], progress: Callable[[str, float], None]) -> Change:
    """Put a law into the library and the joint file, and fit the current model with it.

    Raises
    ------
    InputError
        The law cannot be used, or cannot be in this model.
    """
    analysis, joint = live.analysis(), live.joint()
    if not live.state.steps:
        raise InputError("law: fit the start model first; the law is tried on what that leaves")
    law = typed(body, joint.kind)
    try:
        register(law)
    except LawError as error:
        raise InputError(f"law: {error}") from None
    progress("fitting your law to the residual", 0.2)
    made = analysis.trial_of(law.key)
    text = _kept(live.state.joint_text, joint, law)
    entry = {
        "label": law.key,
        "law": law.text,
        "on": law.places[0],
        "parameters": list(law.parameters),
        "before": live.state.steps[-1].held_out.get("relative_error_percent"),
        "after": made.held_out.get("relative_error_percent"),
        "values": {k: v for k, v in made.values.items() if law.key in k},
    }

    return partial(_noted, text, law.key, entry)


def _noted(text: str, label: str, entry: Mapping[str, Any], s: State) -> State:
    """The state with a law that was tried on its last step."""
    key = s.steps[-1].id
    before = s.found.get(key, {})
    laws = [*(t for t in before.get("laws", []) if t["label"] != label), entry]
    return replace(s, joint_text=text, found={**s.found, key: {**before, "laws": laws}})


def _kept(text: str, joint: Joint, law: TypedLaw) -> str:
    """The joint file with the law in it; its list of effects stays."""
    return with_effects(text, replace(joint, laws={**joint.laws, law.key: law}))


__all__ = ["tried", "typed"]
