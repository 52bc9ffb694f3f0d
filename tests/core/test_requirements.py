"""Identifiers of requirements: what is accepted can stand in XML, and in a list with commas."""

from xml.etree import ElementTree

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.core.requirements import check_requirements

REST = st.one_of(st.text(max_size=70), st.text(st.sampled_from('a0._-,; <&"\n\x01'), max_size=2))
NAMES = st.tuples(st.sampled_from(("a", "Z", "0", "-", "")), REST).map("".join)


@given(NAMES)
@example("a,0")
@example("a\x01")
def test_what_is_accepted_comes_back_from_xml_and_from_a_list_as_it_was(name: str) -> None:
    try:
        check_requirements("verifies", [name])
    except ConfigError as error:
        assert str(error).startswith("verifies[0]: found ") and str(error).isprintable()
        return
    text = ElementTree.tostring(ElementTree.Element("property", value=f"{name},{name}"))
    assert ElementTree.fromstring(text).get("value", "").split(",") == [name, name]


@pytest.mark.parametrize("name", ["SG-1", "FSR-3.2", "a", "x:y/z_1+2", "0" * 64])
def test_usual_identifiers_are_accepted(name: str) -> None:
    check_requirements("verifies", [name])
