"""Identifiers of requirements: what goes into XML, and is not split at a comma."""

from xml.etree import ElementTree

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.core.requirements import check_requirements

REST = st.one_of(st.text(max_size=70), st.text(st.sampled_from('a0._-,; <&"\n\x01'), max_size=2))
NAMES = st.tuples(st.sampled_from(("a", "Z", "0", "-", "")), REST).map("".join)


@pytest.mark.parametrize("name", ["SG-1", "FSR-3.2", "a", "ISO:26262/3+5_b", "x" * 64])
def test_an_identifier(name: str) -> None:
    check_requirements("verifies", ["other", name])


@pytest.mark.parametrize("name", ["", "SG 1", "SG-1,SG-2", "SG-1\n", "SG\x01", "-1", "x" * 65, "§1"])
def test_what_is_none(name: str) -> None:
    with pytest.raises(ConfigError, match=r"verifies\[1\]: found .* allowed is an identifier such as SG-1"):
        check_requirements("verifies", ["SG-1", name])


def test_one_that_stands_twice() -> None:
    with pytest.raises(ConfigError, match=r"verifies\[2\]: SG-1 stands twice"):
        check_requirements("verifies", ["SG-1", "SG-2", "SG-1"])


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
