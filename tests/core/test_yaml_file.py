"""A YAML file that is refused: the error names file, line and key."""

import os
from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from aftbed.core.errors import ConfigError, FileKeyError
from aftbed.core.yaml_file import VALUES_MAX, YAML_BYTES_MAX, in_file, read_yaml


class Wheel(msgspec.Struct, forbid_unknown_fields=True):
    size_mm: Annotated[int, msgspec.Meta(ge=100)]
    tyre: str | None = None


class Cart(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    wheels: list[Wheel] = []
    spares: dict[str, dict[str, Wheel]] = {}


class Limits(msgspec.Struct):
    tolerance: float


GOOD = "name: x\nwheels:\n  - size_mm: 200\n    tyre: winter\n"

# 10^9 values in 400 bytes: each list names the one before it ten times.
LAUGHS = "wheels:\n- &l0 [ha]\n" + "".join(
    f"- &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]\n" for n in range(1, 10)
)


def refusal(path: Path, text: str | bytes) -> str:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as refused:
        read_yaml(path, Cart)
    assert str(refused.value).startswith(f"{path}: ")
    return str(refused.value).removeprefix(f"{path}: ")


def test_a_file_is_read_as_the_struct_that_declares_it(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(GOOD)
    assert read_yaml(path, Cart) == Cart("x", [Wheel(200, "winter")])


@pytest.mark.parametrize("text", ["1e-9", "1E-9", "+1e-09", "1.0e-9", "0.000000001"])
def test_a_number_needs_no_point_before_its_exponent(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(f"tolerance: {text}\n")
    assert read_yaml(path, Limits) == Limits(1e-9)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "line 1, column 1: key 'name' is missing; the file is empty"),
        ("# nothing\n", "line 1, column 1: key 'name' is missing; the file is empty"),
        ("wheels: []\n", "line 1, column 1: key 'name' is missing"),
        (
            GOOD.replace("200", "20"),
            "line 3, column 14: wheels[0].size_mm: found 20, allowed is a whole number at least 100",
        ),
        (
            GOOD.replace("winter", "7"),
            "line 4, column 11: wheels[0].tyre: found 7, allowed is a text",
        ),
        (
            GOOD.replace("tyre", "tire"),
            "line 4, column 5: wheels[0]: unknown key 'tire'; did you mean 'tyre'",
        ),
        (GOOD + "  - tyre: summer\n", "line 5, column 5: wheels[1]: key 'size_mm' is missing"),
        (GOOD + "nome: y\n", "line 5, column 1: unknown key 'nome'; did you mean 'name'?"),
        (GOOD + "name: y\n", "line 5, column 1: key 'name' stands twice"),
        ("name: x\nwheels: 3\n", "line 2, column 9: wheels: found 3, allowed is a list"),
        (
            GOOD + "spares:\n  shed: {old: {size_mm: 100}}\n  attic: {old: {size_mm: 1}}\n",
            "line 7, column 26: spares.attic.old.size_mm: found 1, allowed is a whole number at least 100",
        ),
        ("- 1\n", "line 1, column 1: found [1], allowed is keys and values: name, wheels, spares"),
        ("name: {\n", "line 2, column 1: not YAML here; look for a bracket that"),
        (
            "name: x\nwheels:\n  - &a {size_mm: 200}\n  - {<<: *a}\n",
            "line 4, column 6: a plain value is allowed",
        ),
        (
            "&a name: x\n<<: *b\n",
            "line 2, column 5: not YAML here; look for an alias",
        ),
        (b"\xff\xfe\x00\xd8", "not YAML: "),
        ("[\n" * 5000, "not YAML: "),
        (
            "name: !!python/object:os.system {}\n",
            "line 1, column 7: a plain value is allowed: a text, a number",
        ),
        (b"x" * (YAML_BYTES_MAX + 1), f"cannot be read: {YAML_BYTES_MAX + 1} bytes, allowed are "),
        (LAUGHS, f"not YAML: more than {VALUES_MAX} values, by its aliases"),
        (LAUGHS.replace("- ", "- <<: ").replace("[ha]", "{k: ha}"), "not YAML: "),
        ("name: &a [*a]\n", "not YAML: an alias stands in what it names"),
    ],
)
def test_a_bad_file_is_refused_with_the_line_of_the_error(
    text: str | bytes, reason: str, tmp_path: Path
) -> None:
    assert refusal(tmp_path / "a.yaml", text).startswith(reason)


@pytest.mark.parametrize(
    ("key", "where"),
    [
        ("wheels[0].tyre", "line 4, column 11: "),
        ("wheels[0].colour", "line 3, column 5: "),  # as much of it as is there
        ("wheels[7].tyre", "line 3, column 3: "),
        ("axles", "line 1, column 1: "),
    ],
)
def test_what_is_found_wrong_later_gets_the_same_place(tmp_path: Path, key: str, where: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(GOOD)
    with pytest.raises(ConfigError) as refused, in_file(path):
        raise FileKeyError(key, "worn")
    assert str(refused.value) == f"{path}: {where}{key}: worn"
    with pytest.raises(ConfigError) as refused, in_file(path):
        raise ConfigError("worn")
    assert str(refused.value) == f"{path}: worn"


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        read_yaml(tmp_path / "none.yaml", Cart)


def test_aliases_are_allowed(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("name: x\nwheels:\n- &w {size_mm: 200}\n- *w\n")
    assert read_yaml(path, Cart).wheels == [Wheel(200), Wheel(200)]


def test_what_is_no_regular_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.yaml")
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    for name in ("fifo.yaml", "zero.yaml"):
        with pytest.raises(ConfigError, match=f"{name}: cannot be read: not a regular file"):
            read_yaml(tmp_path / name, Cart)
