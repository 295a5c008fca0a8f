"""The strict conversion between dataclasses and plain values."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from broker_config.errors import MessageError
from broker_config.structure import added, from_plain, to_plain


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    number: float


@dataclass(frozen=True)
class Outer:
    inner: Inner
    colour: Colour
    pair: tuple[int, str]
    many: tuple[Inner, ...]
    table: Mapping[str, int | bool]
    choice: Literal["a", "b"]
    array: NDArray[np.float32]
    note: str | None = None


OUTER = Outer(
    Inner(1.5),
    Colour.RED,
    (1, "x"),
    (Inner(2.0),),
    {"t": 1},
    "a",
    np.array([[1.0, 2.0]], np.float32),
)


def plain(**changes):
    return {**to_plain(OUTER), **changes}


def test_a_nested_dataclass_survives():
    back = from_plain(to_plain(OUTER), Outer, "outer")
    np.testing.assert_array_equal(back.array, OUTER.array)
    assert back.inner == OUTER.inner
    assert back.colour is Colour.RED
    assert (back.pair, back.many, back.table, back.note) == (
        (1, "x"),
        (Inner(2.0),),
        {"t": 1},
        None,
    )


def test_an_integer_serves_as_a_float_and_nothing_else_is_coerced():
    assert from_plain({"number": 3}, Inner, "inner").number == 3.0
    for wrong in (True, "3", None, [3]):
        with pytest.raises(MessageError, match=r"inner\.number: expected float; got"):
            from_plain({"number": wrong}, Inner, "inner")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"inner": 3}, r"outer\.inner: expected a table for Inner; got int 3"),
        ({"inner": {"number": 1.0, "extra": 2}}, r"outer\.inner: expected the fields number; got"),
        ({"inner": {}}, r"outer\.inner: number missing"),
        ({"colour": "blue"}, r"outer\.colour: expected one of 'red'; got str 'blue'"),
        ({"pair": [1]}, r"outer\.pair: expected a list of 2 items"),
        ({"pair": [1, 2]}, r"outer\.pair\[1\]: expected str; got int 2"),
        ({"many": [{"number": "x"}]}, r"outer\.many\[0\]\.number: expected float"),
        ({"many": {"number": 1.0}}, r"outer\.many: expected a list"),
        ({"table": {"t": "x"}}, r"outer\.table\.t: expected int or bool"),
        ({"table": {1: 1}}, r"outer\.table: expected a table with text keys"),
        ({"choice": "c"}, r"outer\.choice: expected one of 'a', 'b'; got str 'c'"),
        ({"note": 3}, r"outer\.note: expected str; got int 3"),
        ({"array": [1.0]}, r"outer\.array: expected an array"),
    ],
)
def test_a_wrong_value_is_named_with_its_path(changes, text):
    with pytest.raises(MessageError, match=text):
        from_plain(plain(**changes), Outer, "outer")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"dtype": "|O"}, "array.dtype: expected one of uint8, int32, float32"),
        ({"dtype": 7}, "array.dtype"),
        ({"shape": [1, -2]}, "array.shape: expected a list of sizes"),
        ({"shape": [True, 2]}, "array.shape"),
        ({"shape": [2**40, 2**40]}, "array.data: expected"),
        ({"shape": [1, 3]}, r"array.data: expected 12 bytes for float32 \[1, 3\]; got bytes 8"),
        ({"data": "text"}, "array.data"),
    ],
)
def test_an_array_that_lies_about_itself_is_refused(changes, text):
    array = {**to_plain(OUTER)["array"], **changes}
    with pytest.raises(MessageError, match=text):
        from_plain(plain(array=array), Outer, "outer")


def test_long_values_are_cut_in_errors():
    with pytest.raises(MessageError) as error:
        from_plain({"number": "x" * 10_000}, Inner, "inner")
    assert len(str(error.value)) < 200


@dataclass(frozen=True)
class Older:
    size: int


@dataclass(frozen=True)
class Newer:
    size: int
    colour: str | None = added(None)


def test_a_field_that_was_added_is_written_only_where_it_is_used():
    assert to_plain(Newer(3)) == to_plain(Older(3))
    assert from_plain(to_plain(Older(3)), Newer, "it") == Newer(3)
    used = Newer(3, "red")
    assert from_plain(to_plain(used), Newer, "it") == used
    with pytest.raises(MessageError, match="got also colour"):
        from_plain(to_plain(used), Older, "it")
