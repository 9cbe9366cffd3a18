"""Files appear whole or not at all; documents are read as data, with the line of every fault."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict

from siq.errors import InputError
from siq.numerics.files import given_path, read_document, validate, whole_file

Write = Callable[..., Path]


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid")
    weight: float
    colour: str = "red"


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    inner: Inner | None = None
    many: dict[str, Inner] = {}
    numbers: list[float] = []


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        validate(read_document(path), Outer)
    return caught.value


def test_every_entry_has_its_line(write: Write) -> None:
    document = read_document(write("# comment\nname: a\n\ninner:\n  weight: 1\nnumbers:\n  - 1\n  - 2\n"))
    assert document.lines == {
        ("name",): 2,
        ("inner",): 4,
        ("inner", "weight"): 5,
        ("numbers",): 6,
        ("numbers", 0): 7,
        ("numbers", 1): 8,
    }
    assert document.data == {"name": "a", "inner": {"weight": 1}, "numbers": [1, 2]}


@pytest.mark.parametrize(
    ("text", "place", "fault"),
    [
        ("name: a\nname: b\n", "line 2", "'name' stands twice (first on line 1)"),
        ("name: a\ninner:\n  weight: 1\n  weight: 2\n", "line 4", "'weight' stands twice (first on line 3)"),
        ("name: [1\n", "line 2", "not valid YAML"),
        ("name: !!python/object/apply:os.system [ls]\n", "line 1", "not valid YAML"),
        ("- 1\n- 2\n", "line 1", "not a mapping"),
        ("", "line 1", "not a mapping"),
        ("name: 2020-13-45\n", "", "not valid YAML"),
    ],
)
def test_a_broken_document_is_refused_with_its_line(write: Write, text: str, place: str, fault: str) -> None:
    error = refusal(write(text))
    assert error.place == place
    assert fault in error.fault
    assert "file.yaml" in error.file


@pytest.mark.parametrize(
    ("text", "place", "remedy"),
    [
        ("nmae: a\nname: b\n", "line 1 (nmae)", "perhaps you meant 'name'"),
        (
            "name: a\ninner:\n  weight: 1\n  color: blue\n",
            "line 4 (inner.color)",
            "perhaps you meant 'colour'",
        ),
        (
            "name: a\nmany:\n  one:\n    weight: 1\n    color: b\n",
            "line 5 (many.one.color)",
            "perhaps you meant 'colour'",
        ),
        ("nmae: a\n", "line 1 (nmae)", "perhaps you meant 'name'"),
        ("name: a\nzzz: 1\n", "line 2 (zzz)", "remove it or use one of inner, many, name, numbers"),
    ],
)
def test_a_misspelt_key_is_told_with_the_nearest_known_one(
    write: Write, text: str, place: str, remedy: str
) -> None:
    error = refusal(write(text))
    assert (error.place, error.remedy) == (place, remedy)


def test_a_missing_key_is_told_with_the_line_of_its_parent(write: Write) -> None:
    error = refusal(write("name: a\ninner:\n  colour: red\n"))
    assert error.place == "line 2 (inner.weight)"
    assert "'weight' is missing" in error.fault


def test_a_value_of_the_wrong_kind_is_told_with_its_line(write: Write) -> None:
    error = refusal(write("name: a\nnumbers:\n  - 1\n  - heavy\n"))
    assert error.place == "line 4 (numbers.1)"
    assert "'heavy'" in error.fault


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml: it cannot be read"):
        read_document(tmp_path / "nowhere.yaml")


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(InputError):
        read_document(path)


def test_an_entry_that_contains_itself_is_refused(write: Write) -> None:
    with pytest.raises(InputError):
        read_document(write("name: &a [*a]\n"))


def test_aliases_that_multiply_are_read_at_once_or_refused(write: Write) -> None:
    levels = ["a0: &a0 [1, 1, 1, 1, 1, 1]"] + [
        f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 6)}]" for k in range(1, 9)
    ]
    path = write("\n".join(levels) + "\n")

    def stop(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(3)
    try:
        assert len(read_document(path).lines) < 100_000
    except InputError:
        pass
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def test_a_file_takes_its_place_when_the_block_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "table.csv"
    with whole_file(path) as partial:
        partial.write_text("1", encoding="utf-8")
        assert partial.suffix == ".csv"
        assert not path.exists()
    assert path.read_text(encoding="utf-8") == "1"
    assert list(path.parent.iterdir()) == [path]


def test_after_an_error_the_old_file_is_there_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old", encoding="utf-8")
    with pytest.raises(ZeroDivisionError), whole_file(path) as partial:
        partial.write_text("half", encoding="utf-8")
        _ = 1 / 0
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_document_that_is_too_large_or_nests_too_deep_is_refused(write: Write) -> None:
    assert "1.2 MB, too many" in refusal(write("name: a\ntitle: " + "a" * 1_200_000)).fault
    deep = refusal(write("name: a\nmany: " + "[" * 100_000 + "]" * 100_000))
    assert deep.place == "line 2" and "more than 20 deep" in deep.fault


def test_keys_are_read_as_formulas_read_names(write: Write) -> None:
    document = read_document(write("ｘ: 1\nµ:\n  Ω: 2\n"))
    assert document.data == {"x": 1, "μ": {"Ω": 2}}
    assert document.lines == {("x",): 1, ("μ",): 2, ("μ", "Ω"): 3}
    assert "stands twice" in refusal(write("µ: 1\nμ: 2\n")).fault


def test_a_path_is_meant_as_it_stands_where_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    Path("~root.csv").touch()
    assert given_path("~root.csv") == Path("~root.csv")
    assert given_path("~nobody-of-this-name.csv") == Path("~nobody-of-this-name.csv")
    assert given_path("~/a.csv") == tmp_path / "home" / "a.csv"
