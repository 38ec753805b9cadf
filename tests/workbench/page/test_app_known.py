"""What is known of a parameter, given in fields of the page, in Debian's Chromium: on the Diagnose
page where an effect asks for it, and on the Model page.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.workbench.chromium import context_of, fit_demo, launched, needs_chromium
from tests.workbench.served import serving

AXE = os.environ.get("IRJ_AXE", "")
SHOTS = os.environ.get("IRJ_SHOTS", "")
GEAR = 160.0

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The demo, fitted and diagnosed."""
    with serving(tmp_path_factory.mktemp("sessions")) as there, launched() as chromium:
        made = context_of(chromium, viewport={"width": 1280, "height": 860}).new_page()
        fit_demo(made, there.address)
        idle(made, "compare")
        made.click("#diagnose")
        idle(made, "diagnose")
        yield made
        idle(made)


def idle(page: Any, view: str = "") -> None:
    """Wait until nothing was asked for, nothing runs, and the screen shows the state."""
    page.wait_for_function(
        "v => (!v || document.querySelector('#main').dataset.view === v) && !app.sent && "
        "!app.waiting && !app.asking && !app.then && app.state && !app.state.job && "
        "app.state.steps.every((s) => s.settled) && "
        "document.querySelector('#main').dataset.revision === String(app.state.revision)",
        arg=view,
        timeout=120_000,
    )


def joint(page: Any) -> dict[str, Any]:
    return tomllib.loads(page.evaluate("app.state.joint_text"))


def findings(page: Any) -> list[tuple[str, str]]:
    """Findings of axe-core of any level, where IRJ_AXE names its file."""
    if not AXE:
        return []
    page.evaluate(Path(AXE).read_text(encoding="utf-8"))
    found = page.evaluate("() => axe.run(document)")
    return [(v["id"], n["html"][:160]) for v in found["violations"] for n in v["nodes"]]


def shot(page: Any, name: str, of: str) -> None:
    """Pictures to look at, where they are asked for."""
    if not SHOTS:
        return
    for theme in ("light", "dark"):
        for width in (1280, 375):
            page.set_viewport_size({"width": width, "height": 860})
            page.evaluate("t => theme(t)", theme)
            page.locator(of).scroll_into_view_if_needed()
            page.screenshot(path=f"{SHOTS}/{name}-{theme}-{width}.png")
    page.evaluate("theme('light')")
    page.set_viewport_size({"width": 1280, "height": 860})


def test_a_known_inertia_is_given_where_the_diagnosis_asks_for_it(page: Any) -> None:
    """On the motor shaft in g.cm2, as a catalogue has it: 1 kg.m2 there is the square of the gear
    ratio on the link. The fit takes it as it stands, and the effect is testable then.
    """
    before = page.evaluate("app.state.diagnosis.not_testable.map((n) => n.effect)")
    assert "extra_inertia" in before
    fitted = page.evaluate("get('/view/parameters')")["motor_inertia"]["value"]
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    give = page.locator("#ask-extra_inertia-give")
    shot(page, "asked", "#ask-extra_inertia-give")
    assert findings(page) == []

    give.click()
    page.wait_for_selector("#error:not([hidden])")
    assert "motor inertia is empty" in page.inner_text("#error-text")
    idle(page, "diagnose")
    assert "known" not in joint(page)

    page.fill("#ask-extra_inertia-motor_inertia-value", f"{fitted / GEAR**2 * 1e7:.6g}")
    page.fill("#ask-extra_inertia-motor_inertia-unit", "V")
    page.select_option("#ask-extra_inertia-motor_inertia-side", "motor")
    give.click()
    page.wait_for_function(
        "() => document.querySelector('#error-text').textContent.includes(\"'V'\")"
    )
    idle(page, "diagnose")
    assert "known" not in joint(page), "a wrong unit changes nothing"

    page.fill("#ask-extra_inertia-motor_inertia-unit", "g.cm2")
    give.click()
    page.wait_for_function("() => app.state.fits > 0", timeout=60_000)
    idle(page, "diagnose")
    assert joint(page)["known"]["motor_inertia"]["side"] == "motor"
    assert joint(page)["known"]["motor_inertia"]["unit"] == "g.cm2"
    held = page.evaluate("get('/view/parameters')")["motor_inertia"]
    assert held["held"]
    assert held["value"] == pytest.approx(fitted, rel=1e-4)

    page.click("#diagnose")
    idle(page, "diagnose")
    assert page.evaluate("Boolean(app.state.diagnosis)")
    now = page.evaluate("app.state.diagnosis.not_testable.map((n) => n.effect)")
    assert "extra_inertia" not in now


def test_another_payload_moves_inertia_and_weight_together(page: Any) -> None:
    """5 kg at 0.4 m: 0.8 kg.m2 and 19.6 N.m more; the fit itself stays."""
    idle(page)
    page.click("#nav-parameters")
    idle(page, "parameters")
    fitted = page.evaluate("get('/view/parameters')")
    error = page.inner_text("#slider-error")
    page.evaluate(
        """() => {
          const fetched = window.fetch;
          window.fetch = async (...asked) => {
            const answer = await fetched(...asked);
            if (String(asked[0]).includes('mass=0&')) await new Promise((go) => window.go = go);
            return answer;
          };
          window.fetchAsBefore = () => { window.fetch = fetched; };
        }"""
    )
    page.fill("#payload-distance", "0.4")  # asks for no mass at this distance
    page.fill("#payload-mass", "5")
    page.keyboard.press("Tab")
    page.wait_for_function(
        "was => document.querySelector('#slider-error').textContent !== was", arg=error
    )
    page.wait_for_function("() => window.go")
    page.evaluate("() => { window.fetchAsBefore(); window.go(); }")  # the older answer comes last
    page.wait_for_timeout(100)
    value = {n: float(page.input_value(f"#value-{n}")) for n in ("link_inertia", "gravity_torque")}
    assert value["link_inertia"] - fitted["link_inertia"]["value"] == pytest.approx(0.8, rel=1e-3)
    weight = fitted["gravity_torque"]["value"], fitted["gravity_cosine"]["value"]
    more = 5 * 9.80665 * 0.4 * weight[0] / math.hypot(*weight)
    assert value["gravity_torque"] - weight[0] == pytest.approx(more, rel=1e-3)
    assert float(page.inner_text("#slider-error").split()[0]) > float(error.split()[0])
    page.wait_for_function(
        "() => document.querySelector('#sliders').textContent.includes('link balance: with')"
    )
    shot(page, "payload", "#payload")
    assert page.evaluate("get('/view/parameters')") == fitted

    page.fill("#payload-mass", "-5000")
    page.keyboard.press("Tab")
    page.wait_for_selector("#error:not([hidden])")
    assert "no inertia left" in page.inner_text("#error-text")
    page.click("#slider-reset")
    assert page.input_value("#payload-mass") == "0"
    assert page.inner_text("#slider-error") == error


def test_what_is_known_is_given_changed_and_taken_back_on_the_model_page(page: Any) -> None:
    idle(page)
    page.click("#nav-model")
    idle(page, "model")
    known = joint(page).get("known", {})
    page.select_option("#known-pick", "stiffness")
    page.click("#known-add")
    page.fill("#known-stiffness-low", "20")
    page.fill("#known-stiffness-high", "60")
    page.fill("#known-stiffness-unit", "kN.m/rad")
    shot(page, "known", "#known")
    assert findings(page) == []
    page.click("#save")
    page.wait_for_function("() => app.state.joint_text.includes('kN.m/rad')")
    idle(page, "model")
    assert joint(page)["known"] == known | {
        "stiffness": {"low": 20.0, "high": 60.0, "unit": "kN.m/rad"}
    }
    assert page.input_value("#known-stiffness-high") == "60"

    page.fill("#known-stiffness-high", "10")
    page.click("#save")
    page.wait_for_selector("#error:not([hidden])")
    assert "low above high" in page.inner_text("#error-text")
    idle(page)

    page.fill("#known-stiffness-low", "")
    page.fill("#known-stiffness-high", "")
    page.click("#save")
    page.wait_for_function("() => !app.state.joint_text.includes('kN.m/rad')")
    idle(page, "model")
    assert joint(page).get("known", {}) == known


@pytest.mark.slow
def test_no_view_has_a_finding_of_any_level(page: Any) -> None:
    """In light and dark, wide and on a phone, with everything unfolded."""
    if not page.evaluate("app.state.steps.length"):
        page.click("#nav-load")
        idle(page, "load")
        page.click("#fit")
        idle(page, "compare")
    for view in (
        "load",
        "model",
        "compare",
        "diagnose",
        "ledger",
        "parameters",
        "replay",
        "plan",
        "export",
    ):
        page.click(f"#nav-{view}")
        idle(page, view)
        page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        assert page.locator("h1").count() == 1, view
        for theme, width in (("light", 1280), ("dark", 375)):
            page.set_viewport_size({"width": width, "height": 860})
            page.evaluate("t => theme(t)", theme)
            # a width that changed is drawn for a moment later, as a window's edge is dragged
            page.wait_for_function(
                "w => document.documentElement.scrollWidth <= w", arg=width, timeout=5_000
            )
            assert findings(page) == [], (view, theme)
        page.evaluate("theme('light')")
        page.set_viewport_size({"width": 1280, "height": 860})
