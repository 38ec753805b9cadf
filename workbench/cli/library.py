"""effects, add: the effect library."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace

from casadi_models import EFFECTS
from casadi_models.text.typed_law import LawError, TypedLaw, derived_key, register
from identification.data.joint_file import Joint
from identification.data.schema import meant
from identification.errors import InputError
from workbench.cli.files import enlarged, open_joint, write_json, write_text


def run_effects(arguments: Namespace) -> int:
    """`irj effects [KEY]`."""
    if arguments.key is not None and arguments.key not in EFFECTS:
        raise InputError(
            f"no effect {arguments.key!r} in the library; `irj effects` lists it"
            f"{meant(arguments.key, EFFECTS)}"
        )
    chosen = [EFFECTS[arguments.key]] if arguments.key is not None else list(EFFECTS.values())
    data = [
        {
            "key": e.key,
            "title": e.title,
            "acts_on": list(e.acts_on),
            "absence": e.absence,
            "excitation": e.excitation,
            "confused_with": list(e.confused_with),
            "needs": list(e.needs),
            "separate_by": e.separate_by,
            "source": e.source,
            "parameters": [
                {"name": p.name, "unit": p.unit, "meaning": p.meaning, "shape": p.is_shape}
                for p in e.parameters
            ],
        }
        for e in chosen
    ]
    for effect in chosen:
        print(f"{effect.key:<28} {effect.title} ({', '.join(effect.acts_on)})")
        if arguments.key:
            print(
                f"  how its absence looks: {effect.absence}\n  what shows it: "
                f"{effect.excitation}\n  source: {effect.source}"
            )
            for p in effect.parameters:
                print(f"  {p.name} [{p.unit}]: {p.meaning}")
            if effect.confused_with:
                print(
                    f"  confused with: {', '.join(effect.confused_with)}; separate by "
                    f"{effect.separate_by or 'another run'}"
                )
    write_json(arguments.json, data)
    return 0


def run_add(arguments: Namespace) -> int:
    """`irj add KEY --joint J -o J2`, or a law typed in one line with `--law`."""
    joint = open_joint(arguments.joint)
    key = arguments.key
    if key is None or arguments.law is not None:
        joint, key = with_law(joint, arguments)
    elif arguments.on or arguments.parameter or arguments.named:
        raise InputError("add: --on, --parameter and --key describe a law; give it with --law")
    try:
        model = joint.model().add(key)
    except (KeyError, ValueError) as error:
        raise InputError(f"{arguments.joint}: {error.args[0]}") from None
    write_text(arguments.output, enlarged(joint, key))
    print(f"{arguments.output}: {', '.join(model.effects)}")
    write_json(arguments.json, {"effects": list(model.effects), "file": arguments.output})
    return 0


def with_law(joint: Joint, arguments: Namespace) -> tuple[Joint, str]:
    """The joint with a typed law among its laws, and the label of its effect."""
    if arguments.law is None:
        raise InputError(
            "add: give the key of an effect, or a law with --law (`irj effects` lists the library)"
        )
    if arguments.key is not None and arguments.named is not None:
        raise InputError(
            f"add: the law has two keys, {arguments.key} and {arguments.named}; give one"
        )
    places = tuple(p.strip() for words in arguments.on for p in words.split(","))
    parameters = tuple(arguments.parameter)
    key = arguments.named or arguments.key or derived_key(arguments.law, places, parameters)
    law = TypedLaw(key, arguments.law, places, parameters, joint.kind)
    try:
        register(law)
    except LawError as error:
        raise InputError(f"--law: {error}") from None
    return replace(joint, laws={**joint.laws, key: law}), key
