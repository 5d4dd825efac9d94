"""Equations as MathML: own names, and a delay as a delay."""

import re
from xml.etree import ElementTree

import pytest

import phsi_opt as ph
from phsi_opt.model.typeset import typeset_equations
from tests.systems import pair


def spring() -> ph.PseudoHamiltonian:
    gain = ph.Parameter()
    energy, loss = "k*q**2/2 + p**2/(2*m)", ph.damping("p")
    return pair(energy, loss, "gain_u*u", k=ph.Parameter(), m=2.5, gain_u=gain)


def told(model: ph.Model, value: float = 0.0053) -> list[str]:
    """The letters of each equation, in the order of reading."""
    lines = typeset_equations(model, dict.fromkeys(model.entries, value), "s")
    told = []
    for line in lines:
        text = line.replace("\N{NO-BREAK SPACE}", " ").replace("&omega;", "ω")
        told.append("".join(ElementTree.fromstring(text).itertext()))
    return told


def test_equations_have_the_names_of_their_parameters() -> None:
    energy, position, momentum = told(spring())
    assert energy == "H=kq22+p22m"
    assert position == "dqdt=pm"
    assert momentum == "dpdt=−kq−Rpq˙+gainuu"


def test_the_velocity_of_a_position_with_a_word_as_name_is_its_rate() -> None:
    model = ph.mechanical(["place"], mass=2.0, forces="-c*v", c=ph.Parameter())
    assert told(model)[-1] == "dpdt=−c(dplacedt)"


def test_a_delay_is_written_as_one_and_not_as_its_states() -> None:
    *_, momentum = told(spring().add("input delay", "p"))
    assert momentum == "dpdt=−kq−Rpq˙+gainuu(t−5.3 ms)"
    lines = told(spring().add("sensor delay", "q"), 2.0)
    assert lines[-1] == "qmeasured=q(t−2 s)" and len(lines) == 4


@pytest.mark.parametrize(
    ("effect", "symbol"),
    [("coulomb friction", "FC"), ("hysteresis", "chysteresis force"), ("gap", "cgap")],
)
def test_effects_are_written_with_the_velocity(effect: str, symbol: str) -> None:
    lines = told(spring().add(effect, "p"))
    assert not any("dH" in line or "N0" in line for line in lines)
    assert any(symbol in line for line in lines)
    assert "Θ" not in "".join(lines), "a step beside max(a, 0) says nothing"


def test_coefficients_without_a_name_are_numbers_and_greek_letters_are_greek() -> None:
    wave = ph.formula("sin(omega*t)", omega=ph.Parameter())
    model = ph.FirstOrder(["x_1"], {"x_1": ph.polynomials(["x_1"], 2) + wave})
    (line,) = told(model, 0.12345)
    assert line == "dx1dt=0.123x12+0.123x1+sin(ωt)"


def test_a_name_cannot_be_markup_and_large_models_are_left_out() -> None:
    (line,) = typeset_equations(ph.FirstOrder(["lt"], {"lt": "-lt"}), {}, "")
    assert re.search("<mi>lt</mi>", line) and "&lt" not in line
    many = ph.FirstOrder(["x"], {"x": ph.polynomials(["x"], 61)})
    assert typeset_equations(many, many.values, "s") == ()


def test_further_words_of_a_name_are_its_index() -> None:
    model = ph.FirstOrder(["T"], {"T": "-loss_to_wall*T"}, kind="thermal")
    larger = model.add("second heat storage", "T")
    rate, _ = typeset_equations(larger, dict.fromkeys(larger.entries, 1.0), "h")
    assert "<msub><mi>loss</mi><mtext>to wall</mtext></msub>" in rate
    assert "<msub><mi>c</mi><mtext>second heat storage</mtext></msub>" in rate


def test_a_late_input_stays_whole_in_a_fraction_and_other_equations_as_they_are() -> (
    None
):
    C, G = ph.Parameter(), ph.Parameter()
    heated = ph.formula("(P - G*(T - s))/C", C=C, G=G)
    rates = {"T": heated, "s": ph.formula("G*(T - s)", G=G)}
    base = ph.FirstOrder(["T", "s"], rates, inputs=["P"], kind="thermal")
    late = base.add("input delay", "T")
    heat, wall = typeset_equations(late, dict.fromkeys(late.entries, 2.0), "s")
    assert re.search(r"<mfrac><mrow><mi>P</mi>.*?</mrow><mi>C</mi></mfrac>", heat)
    assert wall == typeset_equations(base, base.values, "s")[1]


def test_a_difference_begins_with_what_is_positive_and_high_roots_are_powers() -> None:
    tau, a = ph.Parameter(), ph.Parameter()
    room = ph.FirstOrder(
        states=["T"],
        inputs=["Ta"],
        F={"T": ph.formula("(Ta - T)/tau + a*T**0.25", tau=tau, a=a)},
    )
    (rate,) = typeset_equations(room, {"tau": 9.0, "a": 1.0}, "h")
    assert "mroot" not in rate
    assert told(room) == ["dTdt=aT14+Ta−Tτ"]
