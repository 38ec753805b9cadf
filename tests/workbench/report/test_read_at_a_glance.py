"""What a reader meets in report and pictures: names as words, holes explained, one unit, and on a
narrow screen nothing beside it.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from identification import InputError
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improve import Improvement
from identification.fitting.trust import Trust, Trusted
from tests.workbench.chromium import context_of, launched, needs_chromium
from workbench.show import fragments, notebook
from workbench.show.first_page import _formula
from workbench.show.front import exploration_picture, exploration_section
from workbench.show.notebook import interactive
from workbench.show.plots import Overlay, overlay_json
from workbench.show.report import _page
from workbench.show.results import table
from workbench.show.trusted import trusted_html


def plain(html: str) -> str:
    return html.replace("<wbr>", "").replace("\u00a0", " ")


@pytest.mark.parametrize(
    ("names", "made", "said"),
    [
        (("v", "w"), lambda v, w: ca.exp(-((v**2 / w**2 + 1e-12) ** 0.7)), "exp(−(v^2/w^2)^0.7)"),
        (("torque",), lambda t: ca.sqrt(t**2 + 1e-6), "sqrt(torque^2)"),
        (("drive_delay_0", "drive_rate"), lambda a, b: a * b, "hold of the drive·rate of drive"),
        (("motor_velocity",), lambda v: 2e-8 * v, "2e−08·motor velocity"),
        (("lugre_motor_0",), lambda z: -z, "−state 1 of lugre motor"),
        (("stiffness_knot_1",), lambda k: k, "stiffness knot 1"),
    ],
)
def test_a_formula_has_words_and_no_number_of_the_arithmetic(
    names: tuple[str, ...], made: Any, said: str
) -> None:
    shown = plain(_formula(made(*(ca.SX.sym(n) for n in names))))
    assert shown == f"<code class='formula'>{said}</code>"


def overlay(rows: int) -> Overlay:
    torque = np.linspace(0.0, 1.0, rows)
    return Overlay("motor", "run", "N.m", torque, torque, torque, torque, (0.0, 1.0))


def test_holes_of_a_curve_are_explained_where_there_are_any() -> None:
    whole = overlay(100)
    assert fragments.breaks_said([whole]) == ""
    whole.measured[:4] = np.nan
    assert "stands still" in fragments.breaks_said([whole])
    assert "up to 4 % of the rows" in fragments.breaks_said([whole])


STACKED = table(
    ("added", "law", "values"),
    [["+ effect", f"<code class='formula'>{'motor stribeck extra·<wbr>' * 6}</code>", "a = 1"]],
    "Torques",
    stacked=True,
)


@needs_chromium
def test_a_law_and_its_values_are_on_a_narrow_screen_and_labels_are_whole() -> None:
    body = (
        f"<main><div class='scroll'>{STACKED}</div>{fragments.overlay_html([overlay(50)])}</main>"
    )
    law = _page("law", body, overlay_json([overlay(50)]), added=True)
    with launched() as chromium:
        page = context_of(chromium, viewport={"width": 375, "height": 800}).new_page()
        page.set_content(law)
        for cell in page.locator(".stacked td").all():
            box = cell.bounding_box()
            assert box is not None and box["x"] + box["width"] <= 375
            assert cell.evaluate("e => e.scrollWidth <= e.clientWidth + 1")
        assert (
            page.locator(".stacked td")
            .nth(1)
            .evaluate("e => getComputedStyle(e, '::before').content")
            == '"values"'
        )
        page.set_viewport_size({"width": 1280, "height": 900})
        page.locator("#overlay-residual canvas").wait_for()
        plot = page.evaluate("document.querySelector('#overlay-residual .u-over').clientHeight")
        wide = page.evaluate(
            "(() => { const c = document.createElement('canvas').getContext('2d');"
            "c.font = '12px system-ui, sans-serif';"
            "return c.measureText('residual, referred to the link [N\u00b7m]').width; })()"
        )
        assert wide <= plot


def test_a_comparison_and_a_diagnosis_are_documents_too(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[Any] = []
    monkeypatch.setattr(
        notebook, "render_report", lambda found, records: reported.append(found) or "report"
    )
    inside: Any = object.__new__(Improvement)
    assert interactive(Diagnosis(inside)).document == "report"
    assert interactive(inside).document == "report"
    assert reported == [inside, inside]
    wrong: Any = 3
    with pytest.raises(InputError, match="and not int"):
        interactive(wrong)


@cache
def explored() -> Any:
    def variant(name: str, count: int, of_start: float, **more: Any) -> Any:
        usual = {"tied": False, "dropped": (), "behind": "", "score": 0.0, "chosen_percent": 0.0}
        return SimpleNamespace(
            name=name,
            parameters=count,
            error_percent=of_start,
            relative_error_percent=of_start / 60,
            **{**usual, **more},
        )

    start, best = variant("start model", 10, 100.0), variant("+ law", 12, 35.0, tied=True)
    less = variant("- gravity", 11, 20.0, dropped=("gravity",))
    return SimpleNamespace(
        variants=(best, start, less),
        front=(start, best),
        start=start,
        recommended=best,
        ties=(best,),
        improved=best,
        reason="Recommended: this.",
        agreement="The same.",
        alike="",
        stand_ins=(),
        screened=3,
    )


def test_a_front_has_one_unit_and_says_what_lies_below_it() -> None:
    drawn = exploration_picture(explored())
    assert "+ law: 35 % of start, 12 parameters" in drawn
    assert "0.583 %" not in drawn
    assert "others" in drawn and "lacks an effect of the joint file" in " ".join(drawn.split())
    section = exploration_section(explored())
    assert "lacks an effect of the joint file" in section and "of start" in section
    without = SimpleNamespace(**{**vars(explored()), "variants": explored().variants[:2]})
    assert "lacks an effect" not in exploration_picture(without)  # type: ignore[arg-type]


def test_values_by_record_outside_the_interval_are_marked_and_explained() -> None:
    told = Trusted(
        *("stiffness", "N.m/rad", "stiffness", 100.0),
        stderr=0.5,
        low=99.0,
        high=101.0,
        records=(100.5, 102.0, 103.0),
        windows=(),
        partner=None,
        trade="",
        prediction_percent=0.1,
        verdict="trust",
        why="",
        apart=(2,),
    )
    shown = trusted_html(Trust((told,)))
    assert "100.5, 102*, 103!" in shown
    assert "within the error of that record alone" in shown
    assert "by more than noise explains" in shown
