"""Parameter sets of SSP (SSV): start values by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final
from xml.etree.ElementTree import Element, SubElement

from irj_fmu.fmi.model_description import to_bytes

SSV: Final = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
SSC: Final = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def parameter_set(name: str, values: Mapping[str, tuple[str, float]]) -> bytes:
    """A set as a file of its own; type and value by name."""
    root = Element(
        "ssv:ParameterSet", {"xmlns:ssv": SSV, "xmlns:ssc": SSC, "name": name, "version": "1.0"}
    )
    add_parameters(root, values)
    return to_bytes(root)


def add_parameters(owner: Element, values: Mapping[str, tuple[str, float]]) -> None:
    """Write type and value by name into a set."""
    entries = SubElement(owner, "ssv:Parameters")
    for name, (kind, value) in values.items():
        SubElement(
            SubElement(entries, "ssv:Parameter", {"name": name}),
            f"ssv:{kind}",
            {"value": repr(value)},
        )


__all__ = ["SSC", "SSV", "add_parameters", "parameter_set"]
