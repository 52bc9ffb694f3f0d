"""Identifiers of requirements: what is accepted can stand in XML, and in a list with commas."""

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.core.requirements import check_requirements

NEAR = st.text(st.sampled_from("aZ09._:/+-, ;|<&\"'\n\x00\x01\ufffeé"), max_size=70)


@given(st.lists(st.one_of(st.text(max_size=70), NEAR), max_size=4))
def test_what_is_accepted_comes_back_from_xml_as_it_was(names: list[str]) -> None:
    try:
        check_requirements("verifies", names)
    except ConfigError as error:
        assert str(error).startswith("verifies[") and str(error).isprintable()
        return
    text = ElementTree.tostring(ElementTree.Element("property", value=",".join(names)))
    value = ElementTree.fromstring(text).get("value", "")
    assert (value.split(",") if value else []) == names


@pytest.mark.parametrize("name", ["SG-1", "FSR-3.2", "a", "x:y/z_1+2", "0" * 64])
def test_usual_identifiers_are_accepted(name: str) -> None:
    check_requirements("verifies", [name])
