"""Forged submissions: each function forges one in place, of a valid one in a folder, with a generator of its own.

`READ` are refused when they are opened, `REPLAYED` only when their actions are executed: their author made the hashes
anew, and all that they say could be.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from lerobot_constructskill.board.submission import DECLARATION_FILE, EPISODES_FILE, RECIPE_FILE
from lerobot_constructskill.perturbations import PICTURES

type Forge = Callable[[Path, np.random.Generator], None]

SEEING = "physx_cpu, sapien_cpu rendering"
"""A backend that shows pictures."""

READ: dict[str, Forge] = {}
REPLAYED: dict[str, Forge] = {}


def forges(into: dict[str, Forge]) -> Callable[[Forge], Forge]:
    def keep(forge: Forge) -> Forge:
        into[forge.__name__] = forge
        return forge

    return keep


def edit(root: Path, change: Callable[[list[dict]], None], schema: pa.Schema | None = None, **options) -> None:
    """Change the rows, and make the hash anew."""
    table = pq.read_table(root / EPISODES_FILE)
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=schema or table.schema), root / EPISODES_FILE, **options)
    rehash(root)


def rehash(root: Path) -> None:
    declare(
        root, lambda said: said.update(episodes_sha256=hashlib.sha256((root / EPISODES_FILE).read_bytes()).hexdigest())
    )


def declare(root: Path, change: Callable[[dict], None]) -> None:
    said = yaml.safe_load((root / DECLARATION_FILE).read_text())
    change(said)
    (root / DECLARATION_FILE).write_text(yaml.safe_dump(said, sort_keys=False))


def overwrite(root: Path, text: str) -> None:
    """Put lines before submission.yaml's own."""
    (root / DECLARATION_FILE).write_text(text + (root / DECLARATION_FILE).read_text())


def placed(rows: list[dict], rng: np.random.Generator) -> dict:
    return rng.choice([row for row in rows if row["placed"]])


# Refused when opened


@forges(READ)
def a_perturbed_setting_without_its_control(root, rng):
    """Played with the task as it is, and called perturbed."""
    declare(root, lambda said: said["settings"]["brick_to_bin_shifted"].update(perturb="pose=3"))


@forges(READ)
def a_control_called_perturbed(root, rng):
    """Other light moves nothing, so that the control's actions end in it as they end in the control."""
    axis = rng.choice(PICTURES)
    declare(
        root,
        lambda said: said["settings"].update(
            perturbed=said["settings"]["brick_to_bin_shifted"] | {"perturb": f"{axis}=2"}
        ),
    )
    edit(
        root,
        lambda rows: rows.extend(
            [row | {"setting": "perturbed"} for row in rows if row["setting"] == "brick_to_bin_shifted"]
        ),
    )


@forges(READ)
def a_task_called_perturbed(root, rng):
    """The columns of the suite `perturbed` are its axes."""

    def change(said):
        said["suite"] = "perturbed"
        said["settings"]["pose"] = said["settings"].pop("brick_to_bin_shifted")

    declare(root, change)
    edit(root, lambda rows: [row.update(setting="pose") for row in rows if row["setting"] == "brick_to_bin_shifted"])


@forges(READ)
def a_setting_called_as_a_harder_task(root, rng):
    def change(said):
        said["suite"] = "ladder"
        said["settings"]["brick_to_bin_shifted"]["task"] = "brick_to_bin_40mm"

    declare(root, change)


@forges(READ)
def a_bit_of_the_file(root, rng):
    content = bytearray((root / EPISODES_FILE).read_bytes())
    content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    (root / EPISODES_FILE).write_bytes(content)


@forges(READ)
def an_action_without_its_hash(root, rng):
    kept = (root / DECLARATION_FILE).read_text()
    edit(root, lambda rows: placed(rows, rng)["actions"].__setitem__(int(rng.integers(300)), 0.05))
    (root / DECLARATION_FILE).write_text(kept)


@forges(READ)
def a_dropped_failure(root, rng):
    edit(root, lambda rows: rows.remove(rng.choice([row for row in rows if not row["placed"]])))


@forges(READ)
def a_success_in_a_failures_place(root, rng):
    def change(rows):
        good, bad = placed(rows, rng), rng.choice([row for row in rows if not row["placed"]])
        rows[rows.index(bad)] = dict(good)

    edit(root, change)


def copied(rows: list[dict], rng: np.random.Generator) -> dict:
    """Copy a success to the other training seed, and return the copy."""
    good = placed(rows, rng)
    (other,) = (
        row
        for row in rows
        if row["training_seed"] != good["training_seed"]
        and (row["setting"], row["evaluation_seed"]) == (good["setting"], good["evaluation_seed"])
    )
    other.update({name: value for name, value in good.items() if name != "training_seed"})
    return other


@forges(READ)
def a_success_copied_to_the_other_training_seed(root, rng):
    edit(root, lambda rows: copied(rows, rng))


@forges(READ)
def a_success_copied_beyond_the_jaws_reach(root, rng):
    """The gripper asked for more than there is: other numbers, and the same actions once they are executed."""

    def change(rows):
        copy = copied(rows, rng)
        copy["actions"] = [4 * one if number % 4 == 3 else one for number, one in enumerate(copy["actions"])]

    edit(root, change)


@forges(READ)
def outcomes_that_contradict_each_other(root, rng):
    others = (
        *({"placed": False}, {"lifted": False}, {"stage": "none"}, {"stage": "lifted"}, {"lift_step": None}),
        *({"place_step": None}, {"place_step": 1}, {"place_step": 10**9}, {"lift_step": -7}, {"lift_step": 0}),
    )
    edit(root, lambda rows: placed(rows, rng).update(rng.choice(others)))


@forges(READ)
def another_start(root, rng):
    edit(root, lambda rows: rng.choice(rows).update(evaluation_seed=int(rng.integers(2**31))))


@forges(READ)
def a_swapped_training_seed(root, rng):
    edit(root, lambda rows: rng.choice(rows).update(training_seed=int(rng.integers(2, 9))))


@forges(READ)
def an_unknown_setting(root, rng):
    edit(root, lambda rows: rng.choice(rows).update(setting=rng.choice(["../../etc", "", "x" * 9999, "a\x00b", "名"])))


@forges(READ)
def an_action_that_is_no_number(root, rng):
    bad = float(rng.choice([np.nan, np.inf, -np.inf]))
    edit(root, lambda rows: placed(rows, rng)["actions"].__setitem__(int(rng.integers(300)), bad))


@forges(READ)
def too_few_actions(root, rng):
    def change(rows):
        row = rng.choice(rows)
        row["actions"] = row["actions"][: int(rng.integers(len(row["actions"])))]

    edit(root, change)


@forges(READ)
def impossible_steps(root, rng):
    edit(root, lambda rows: rng.choice(rows).update(steps=int(rng.choice([0, -1, 301, 2**62]))))


@forges(READ)
def an_unknown_stage(root, rng):
    edit(root, lambda rows: rng.choice(rows).update(stage=rng.choice(["done", "", "<script>"])))


@forges(READ)
def a_success_beside_an_error(root, rng):
    edit(root, lambda rows: placed(rows, rng).update(error="out of memory"))


@forges(READ)
def counts_that_cannot_be(root, rng):
    counts = [{"chain": 2, "placements": 1}, {"chain": 1}, {"knocks": -1}, {"placements": 10}, {"drops": -(2**60)}]
    edit(root, lambda rows: rng.choice(rows).update(rng.choice(counts)))


@forges(READ)
def a_count_beside_an_error(root, rng):
    empty = {"lifted": False, "placed": False, "stage": "none", "lift_step": None, "place_step": None, "steps": 0}
    edit(root, lambda rows: rng.choice(rows).update(empty, error="out of memory", actions=[], knocks=0))


@forges(READ)
def a_truncated_file(root, rng):
    content = (root / EPISODES_FILE).read_bytes()
    (root / EPISODES_FILE).write_bytes(content[: int(rng.integers(len(content)))])
    rehash(root)


@forges(READ)
def noise_in_the_file(root, rng):
    """As a fuzzer would: many bytes anywhere, and the hash made anew."""
    content = np.frombuffer((root / EPISODES_FILE).read_bytes(), np.uint8).copy()
    where = rng.integers(len(content) // 2, len(content), size=200)
    content[where] = rng.integers(256, size=len(where))
    (root / EPISODES_FILE).write_bytes(content.tobytes())
    rehash(root)


@forges(READ)
def another_column(root, rng):
    schema = pq.read_schema(root / EPISODES_FILE)
    kind = rng.choice(["more", "less", "wider"])
    if kind == "more":
        schema = schema.append(pa.field("score", pa.float64()))
    elif kind == "less":
        schema = schema.remove(int(rng.integers(len(schema))))
    else:
        schema = schema.set(schema.get_field_index("steps"), pa.field("steps", pa.float64(), nullable=False))
    edit(root, lambda rows: None, schema)


@forges(READ)
def a_bomb_of_rows(root, rng):
    edit(root, lambda rows: rows.extend([rows[0]] * 200_000), compression="zstd")


@forges(READ)
def a_bomb_of_actions(root, rng):
    """Some 50 KB that unpack to 400 MB."""
    edit(root, lambda rows: rows[0].update(actions=np.zeros(100_000_000, np.float32)), compression="zstd")


@forges(READ)
def a_bomb_of_text(root, rng):
    edit(root, lambda rows: rows[0].update(error="0" * 500_000_000), compression="zstd")


@forges(READ)
def a_file_too_large(root, rng):
    os.truncate(root / EPISODES_FILE, int(rng.integers(65 << 20, 1 << 40)))  # sparse


@forges(READ)
def many_declared_rows(root, rng):
    declare(root, lambda said: next(iter(said["settings"].values())).update(episodes=int(rng.integers(10**4, 10**12))))


@forges(READ)
def many_declared_seeds(root, rng):
    declare(root, lambda said: said.update(training_seeds=list(range(int(rng.integers(300, 3000))))))


@forges(READ)
def a_bomb_of_aliases(root, rng):
    rows = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    rows += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)]
    overwrite(root, "\n".join(rows) + "\n")


@forges(READ)
def a_tag(root, rng):
    tag = rng.choice(
        ["!!python/object/apply:os.system [touch /tmp/forged]", "!!python/name:os.system", "!x y", "!!set {}"]
    )
    overwrite(root, f"notes: {tag}\n")


@forges(READ)
def yaml_that_is_none(root, rng):
    text = rng.choice(
        ["[" * 60_000, "{" * 9000, "\x00", "9" * 9000, "? [a]\n: b", "- a", "", "a: b: c", "\ufeff\ud7ff"]
    )
    (root / DECLARATION_FILE).write_text(str(text))


@forges(READ)
def a_key_twice(root, rng):
    overwrite(root, "suite: joints\n")


@forges(READ)
def a_number_of_too_many_digits(root, rng):
    """Python refuses to print it, in a refusal for instance, and to turn it into a float."""
    number = rng.choice(["0x" + "f" * 5000, "1:" + "59:" * 15_000 + "59.5", "-0x" + "e" * 4000])
    text = (root / DECLARATION_FILE).read_text()
    (root / DECLARATION_FILE).write_text(text.replace("version: 1\n", f"version: {number}\n"))


@forges(READ)
def a_huge_declaration(root, rng):
    overwrite(root, "# " + "x" * (1 << 17) + "\n")


@forges(READ)
def a_link(root, rng):
    name = rng.choice([DECLARATION_FILE, EPISODES_FILE])
    target = rng.choice(["/etc/passwd", "/dev/zero", "missing"])
    (root / name).unlink()
    (root / name).symlink_to(target)


@forges(READ)
def a_pipe(root, rng):
    (root / EPISODES_FILE).unlink()
    os.mkfifo(root / EPISODES_FILE)


@forges(READ)
def another_file(root, rng):
    (root / rng.choice(["setup.py", "verified.json", ".hidden", "policy.pkl", "é\n名"])).write_text("x")


@forges(READ)
def a_missing_file(root, rng):
    (root / rng.choice([DECLARATION_FILE, EPISODES_FILE])).unlink()


@forges(READ)
def a_field_that_is_none(root, rng):
    declare(root, lambda said: said.update({str(rng.choice(["level", "verified", "__class__"])): "replayed"}))


@forges(READ)
def a_field_of_another_kind(root, rng):
    name = rng.choice(["about", "settings", "training_seeds", "versions", "suite", "episodes_sha256", "version"])
    declare(root, lambda said: said.update({name: rng.choice([None, "x", -1.5, True])}))


@forges(READ)
def text_that_hides_text(root, rng):
    name = rng.choice(["name", "submitter", "revision", "data"])
    bad = rng.choice(["a\u202eb", "a\nb", "", "\x1b[31mred", "x" * 999, "a\u200bb"])
    declare(root, lambda said: said["about"].update({name: str(bad)}))


@forges(READ)
def an_address_that_is_a_script(root, rng):
    url = rng.choice(["javascript:alert(1)", "file:///etc/passwd", "http://x", 'https://x"onclick="y'])
    declare(root, lambda said: said["about"].update(url=str(url)))


@forges(READ)
def pictures_that_nobody_rendered(root, rng):
    shown = ["physx_cpu, none rendering", "physx_cpu, none rendering ", "physx_cpu", "physx_cpu,none rendering"]
    declare(root, lambda said: said.update(backend=str(rng.choice([*shown, "physx_cpu, NONE rendering"]))))


@forges(READ)
def no_version_of_what_it_was_made_with(root, rng):
    name = rng.choice(["sapien", "mani_skill", "numpy", "torch", "lerobot_env_constructskill"])
    declare(root, lambda said: said["versions"].pop(name))


@forges(READ)
def starts_of_demonstrations(root, rng):
    first = int(rng.choice([999_999, 1_000_000, 2**30 - 1]))

    def change(said):
        for setting in said["settings"].values():
            setting["first_start"] = first

    declare(root, change)
    edit(root, lambda rows: [row.update(evaluation_seed=first + row["evaluation_seed"] - 5000) for row in rows])


@forges(READ)
def a_recipe_that_is_not_declared(root, rng):
    (root / RECIPE_FILE).write_text(rng.choice(["", "name: mine\n", "!!python/name:os.system"]))


@forges(READ)
def a_declared_recipe_that_is_not_there(root, rng):
    weights = {"brick_to_bin_shifted": [None, "0" * 64], "block_to_bin": [None, None]}
    trained = {"recipe_sha256": "0" * 64, "weights": weights, "made_with": {}}
    declare(root, lambda said: said.update(trained=trained))


@forges(READ)
def weights_of_too_few_seeds(root, rng):
    weights = {"brick_to_bin_shifted": ["0" * 64], "block_to_bin": [None, None]}
    trained = {"recipe_sha256": hashlib.sha256(b"").hexdigest(), "weights": weights, "made_with": {}}
    declare(root, lambda said: said.update(trained=trained))
    (root / RECIPE_FILE).touch()


# Refused when replayed


@forges(REPLAYED)
def other_counts(root, rng):
    """It dropped nothing, knocked nothing over, and laid more."""
    counts = [{"chain": 3, "placements": 3}, {"drops": 7}, {"knocks": 1}, {"collisions": 1000}]
    edit(root, lambda rows: rng.choice([row for row in rows if not row["placed"]]).update(rng.choice(counts)))


@forges(REPLAYED)
def another_outcome(root, rng):
    others = {"lift_step": 1}, {"placed": False, "place_step": None, "stage": "in_bin"}
    edit(root, lambda rows: placed(rows, rng).update(rng.choice(others)))


@forges(REPLAYED)
def a_failure_called_success(root, rng):
    def change(rows):
        row = rng.choice([row for row in rows if not row["placed"]])
        row.update(lifted=True, placed=True, stage="placed", lift_step=50, place_step=row["steps"])

    edit(root, change)


@forges(REPLAYED)
def actions_of_another_start(root, rng):
    def change(rows):
        row = placed(rows, rng)
        others = [one for one in rows if one["setting"] == row["setting"] and one["placed"] and one is not row]
        row.update({name: others[0][name] for name in ("actions", "steps", "lift_step", "place_step")})

    edit(root, change)


@forges(REPLAYED)
def actions_of_another_task(root, rng):
    def change(rows):
        row = placed(rows, rng)
        other = placed([one for one in rows if one["setting"] != row["setting"]], rng)
        row.update({name: value for name, value in other.items() if name not in ("setting", "evaluation_seed")})

    edit(root, change)


@forges(REPLAYED)
def a_hand_that_opens(root, rng):
    """Fifteen bits: the gripper's sign while it lifts."""

    def change(rows):
        row = placed(rows, rng)
        for step in range(row["lift_step"] - 3, row["lift_step"] + 12):
            row["actions"][4 * step - 1] = 1.0

    edit(root, change)


@forges(REPLAYED)
def an_end_too_early(root, rng):
    def change(rows):
        row = placed(rows, rng)
        row["steps"] -= int(rng.integers(1, 9))
        row["place_step"] = row["steps"]
        row["actions"] = row["actions"][: 4 * row["steps"]]

    edit(root, change)


@forges(REPLAYED)
def actions_after_the_end(root, rng):
    def change(rows):
        row = placed(rows, rng)
        row["steps"] += 1
        row["place_step"] = row["steps"]
        row["actions"] = [*row["actions"], 0.0, 0.0, 0.0, 1.0]

    edit(root, change)


@forges(REPLAYED)
def an_easier_setting(root, rng):
    """Played with the task as it is, and called perturbed, beside its control."""

    def change(said):
        said["settings"]["moved"] = said["settings"]["brick_to_bin_shifted"] | {"perturb": "pose=3"}

    def play(rows):
        placed = [row for row in rows if row["setting"] == "brick_to_bin_shifted" and row["placed"]]
        for seed in (0, 1):  # another's actions would be refused as a copy
            rows += [row | {"setting": "moved", "training_seed": seed, "actions": nudged(row, seed)} for row in placed]

    def nudged(row, seed):
        return (np.array(row["actions"]) + 0.002 * seed * (np.arange(len(row["actions"])) % 8 == 0)).tolist()

    declare(root, change)
    edit(root, play)
