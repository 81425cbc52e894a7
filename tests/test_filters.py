"""The filter language: agrees with plain Python, and refuses everything else with a message."""

import builtins
import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_swr.styles.filters import FilterError, names_in, parse_filter, select

TABLE = {
    "length": [62.0, 70.0, 75.0, 80.0, 101.0],
    "first_0": [-0.5, 0.0, 0.25, 0.25, 1.0],
    "behavior": ["6410", "7420", "6410", "", "6310"],
    "success": [True, True, False, True, False],
}

NUMBERS = st.integers(-3, 3) | st.floats(-3, 3).map(lambda x: round(x, 2))
TEXTS = st.text("ab'\"\\ 0", max_size=3)


def tables() -> st.SearchStrategy:
    """Random tables of 0 to 6 rows with columns of every kind."""
    return st.integers(1, 6).flatmap(
        lambda n: st.fixed_dictionaries(
            {
                "x": st.lists(NUMBERS, min_size=n, max_size=n),
                "y": st.lists(NUMBERS, min_size=n, max_size=n),
                "s": st.lists(TEXTS, min_size=n, max_size=n),
                "t": st.lists(TEXTS, min_size=n, max_size=n),
                "ok": st.lists(st.booleans(), min_size=n, max_size=n),
            }
        )
    )


def _comparison(operands: st.SearchStrategy, operators: list[str]) -> st.SearchStrategy:
    """`a < b <= c`, with one to three operators."""
    links = st.lists(st.tuples(st.sampled_from(operators), operands), min_size=1, max_size=3)
    return st.tuples(operands, links).map(lambda p: p[0] + "".join(f" {op} {right}" for op, right in p[1]))


def _membership(name: st.SearchStrategy, constants: st.SearchStrategy) -> st.SearchStrategy:
    """`a in (…,)` or `a not in […]`."""
    members = st.lists(constants, max_size=3)
    return st.tuples(name, st.sampled_from(["in", "not in"]), members, st.booleans()).map(
        lambda p: f"{p[0]} {p[1]} {p[2] if p[3] else tuple(p[2])}"
    )


ORDERED = ["<", "<=", ">", ">=", "==", "!="]
CONDITIONS = st.recursive(
    st.one_of(
        _comparison(st.sampled_from(["x", "y"]) | NUMBERS.map(repr), ORDERED),
        _comparison(st.sampled_from(["s", "t"]) | TEXTS.map(repr), [*ORDERED, "in", "not in"]),
        _comparison(st.sampled_from(["ok", "True", "False"]), ["==", "!="]),
        _membership(st.sampled_from(["x", "y"]), NUMBERS),
        _membership(st.sampled_from(["s", "t"]), TEXTS),
        st.sampled_from(["ok", "True", "False"]),
    ),
    lambda inner: st.one_of(
        inner.map(lambda c: f"not ({c})"),
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(lambda p: f"({p[0]}) {p[1]} ({p[2]})"),
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(lambda p: f"{p[0]} {p[1]} {p[2]}"),
    ),
    max_leaves=6,
)


@settings(max_examples=150)
@given(table=tables(), condition=CONDITIONS)
def test_random_filters_agree_with_plain_python(table, condition):
    """The independent oracle is Python's own `eval`, row by row."""
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    expected = [bool(eval(condition, {"__builtins__": {}}, row)) for row in rows]
    assert select(condition, table).tolist() == expected


@settings(max_examples=150)
@given(text=st.text(max_size=60) | st.text("()[]{}'\".,:+-*/=<>!&|^~@lambda inotrx0123_ \n\\", max_size=60))
def test_any_text_is_a_filter_or_a_filter_error(text):
    """No text whatever raises anything else than a `FilterError`."""
    with contextlib.suppress(FilterError):
        assert select(text, TABLE).shape == (5,)


@pytest.mark.parametrize(
    ("text", "episodes"),
    [
        ("70 <= length <= 80", [1, 2, 3]),
        ("70 <= length <= 80 and behavior == '6410'", [2]),
        ("not success", [2, 4]),
        ("success and first_0 >= -.25", [1, 3]),
        ("behavior in ('6410', '6310') or length < 63", [0, 2, 4]),
        ("'4' in behavior", [0, 1, 2]),
        ("behavior not in ['6410']", [1, 3, 4]),
        ("-1 < first_0 < +0.1", [0, 1]),
        ("True", [0, 1, 2, 3, 4]),
        ("length > 1000", []),
        ("(length > 60)\n", [0, 1, 2, 3, 4]),
    ],
)
def test_examples(text, episodes):
    """What the documentation shows."""
    assert np.flatnonzero(select(text, TABLE)).tolist() == episodes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lenght > 70", r"unknown name 'lenght'; known: length 62 to 101; first_0 -0.5 to 1; behavior '', "),
        ("behavior == 6410", r"behavior holds text, write behavior == '6410'"),
        ("length == '70'", r"length holds number, write length == 70"),
        ("length", r"this is a number, not a condition"),
        ("length and success", r"length is a number, not a condition"),
        ("not length", r"length is a number, not a condition"),
        ("behavior in (6410, '7420')", r"behavior is a text, 6410 in its list is not"),
        ("length in behavior", r"'in' needs a list, or text in text"),
        ("success < True", r"no order"),
        ("length is 70", r"'is' is not allowed; write =="),
        ("(70, 80) == length", r"a list can only stand to the right of 'in'"),
        ("length >", r"invalid syntax; expected e.g. "),
        ("", r"invalid syntax"),
    ],
)
def test_mistakes_are_explained(text, message):
    """Unknown names, type errors and syntax errors name the fault, the known columns and the fix."""
    with pytest.raises(FilterError, match=message):
        select(text, TABLE)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "().__class__.__bases__[0].__subclasses__()",
        "behavior.__class__ == 1",
        "length[0] == 1",
        "open('/etc/passwd')",
        "(lambda: 1)() == 1",
        "[x for x in (1, 2)] == 1",
        "f'{length}' == 'a'",
        "9**9**9 > length",
        "length * 2 > 3",
        "length == 1" + "0" * 1500,
        "length < 1e999",
        "length < 1e16",
        "length == 1j",
        "behavior == b'6410'",
        "length == None",
        "length == ...",
        "(x := 1) == 1",
        "length in {1: 2}",
        "length in {1, 2}",
        "length in (*(1, 2),)",
        "length in ((1, 2), 3)",
        "length in (length, 2)",
        "~length == 1",
        "-behavior == '1'",
        "-True",
        "1 if success else 0",
        "import os",
        "success; success",
        "success\nsuccess",
        "yield 1",
        "\x00",
        "(" * 900 + "success" + ")" * 900,
        "not " * 100 + "success",
        "not " * 490 + "success",
        "- " * 900 + "1 < length",
        "success and " * 1000 + "success",
        "'" + "a" * 5000 + "' == behavior",
    ],
)
def test_hostile_input_is_refused(text, monkeypatch):
    """Calls, attributes, arithmetic, huge literals and deep nesting are filter errors; nothing is run."""
    monkeypatch.setattr(builtins, "eval", None)
    monkeypatch.setattr(builtins, "exec", None)
    with pytest.raises(FilterError, match="style_filter="):
        select(text, TABLE)


def test_syntax_can_be_checked_without_a_table():
    """A configuration refuses a broken filter before any checkpoint is loaded."""
    parse_filter("anything > 3")
    with pytest.raises(FilterError, match=r"expected e\.g\."):
        parse_filter("anything >")


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("return > 10", [1]),
        ("2 < return <= 20 and task != 'return'", [1]),
        ("'return' in task or return == 1", [0, 2]),
        ("(return\n > 10)", [1]),
    ],
)
def test_a_column_may_be_called_like_a_statement(text, kept):
    """The table has one called return, which Python keeps for itself; strings stay as they are."""
    table = {"return": [1.0, 20.0, 3.0], "task": ["a", "b", "return"]}
    assert np.flatnonzero(select(text, table)).tolist() == kept
    assert names_in(text) == {"return"} | ({"task"} if "task" in text else set())


def test_a_statement_is_no_filter():
    """An unknown one is told under its own name."""
    for text, message in (
        ("return 1", "invalid syntax"),
        ("class > 3", "unknown name 'class'; known: length"),
    ):
        with pytest.raises(FilterError, match=message):
            select(text, {"length": [1.0]})
