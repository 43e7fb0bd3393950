"""Our configuration files: nothing in one is dropped without a word, and none takes the machine with it."""

from itertools import pairwise

import pytest

from lerobot_constructskill.errors import InputError
from lerobot_constructskill.parsing import read_fields

NAMES = "abcdefgh"
TENFOLD = "".join(f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]\n" for before, name in pairwise(NAMES))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3: 'a' stands there a second time"),
        ("variants: {ours: {seeds: 1}, ours: {seeds: 2}}\n", "line 1: 'ours' stands there a second time"),
        ("a: &a [1, 2]\n" + TENFOLD, "its aliases multiply"),
        ("a: &a [*a]\n", "its aliases multiply"),
        ("[" * 100_000, "is nested too deeply"),
    ],
    ids=["a key", "a variant", "aliases", "itself", "depth"],
)
def test_what_would_be_lost_or_too_much_is_refused_in_one_sentence(text, said, tmp_path):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        read_fields(tmp_path / "mine.yaml")
    assert str(refused.value).startswith(f"'{tmp_path / 'mine.yaml'}'") and "\n" not in str(refused.value)


def test_anchors_and_merge_keys_are_for_saying_a_thing_once(tmp_path):
    (tmp_path / "mine.yaml").write_text("base: &base {a: 1, b: 2}\nmine:\n  <<: *base\n  a: 3\n")
    assert read_fields(tmp_path / "mine.yaml")["mine"] == {"a": 3, "b": 2}
