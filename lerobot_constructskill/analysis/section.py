"""The `analysis` section of a study's file: labels, order and comparisons of its report. It changes no run."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Annotated

from lerobot_constructskill.bounds import Range, Text, check
from lerobot_constructskill.errors import InputError

Level = Annotated[float, Range(above=0, most=0.5)]


@dataclass(frozen=True)
class Analysis:
    """Labels, order and tests of a report.

    Args:
        labels: name of a setting, variant, reference, sweep or mean to its name in tables; the name itself by default.
        order: variants that come first, in this order; the others follow in the order of the study.
        comparisons: pairs of variants to test, the family that Holm's correction covers; by default every pair with
            equally many planned seeds.
        alpha: level of the tests.
        sweeps: name of what is varied to the settings that differ in it, the one without the variation first. They
            share a table and a figure, and have a section each only if they compare variants. Variants with the same
            label are one line.
        means: name of some tasks to the settings that evaluate on them: a section each, on the mean over tasks of
            every seed that ran in all of them.

    Raises:
        InputError: a comparison is no pair or declared twice, or a sweep or mean has fewer than two settings.
    """

    labels: dict[str, Text] = field(default_factory=dict)
    order: list[str] = field(default_factory=list)
    comparisons: list[list[str]] | None = None
    alpha: Level = 0.05
    sweeps: dict[str, list[str]] = field(default_factory=dict)
    means: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self):
        check(self, "analysis.")
        for pair in self.comparisons or []:
            if len(pair) != 2 or pair[0] == pair[1]:
                raise InputError(f"A comparison must be a pair of variants, not {pair}.")
        if len({frozenset(pair) for pair in self.comparisons or []}) < len(self.comparisons or []):
            raise InputError("Each comparison is declared once: twice it would count twice in Holm's correction.")
        for name, settings in [*self.sweeps.items(), *self.means.items()]:
            if len(settings) < 2 or len(set(settings)) < len(settings):
                raise InputError(f"A sweep or mean must be two settings or more, each once; '{name}' is {settings}.")

    def check(self, variants: Collection[str], settings: Collection[str], references: Collection[str] = ()) -> None:
        """Check that the study has every name.

        Raises:
            InputError: a name is unknown, or a sweep has the name or the first setting of something else.
        """
        _check_known("variant in comparisons", chain.from_iterable(self.comparisons or []), variants)
        _check_known("variant in order", self.order, variants)
        _check_known("name in labels", self.labels, [*variants, *settings, *references, *self.sweeps, *self.means])
        _check_known("setting in sweeps", chain.from_iterable(self.sweeps.values()), settings)
        _check_known("setting in means", chain.from_iterable(self.means.values()), settings)
        varied = {name for swept in self.sweeps.values() for name in swept[1:]}
        for name in (*self.sweeps, *self.means):
            if name in (*variants, *settings, *references):
                raise InputError(f"The sweep or mean '{name}' needs a name that nothing else in the study has.")
        for name, swept in self.sweeps.items():
            if swept[0] in varied:
                raise InputError(f"'{swept[0]}' begins the sweep '{name}' and must not be varied in another.")

    def check_settings(self, variants_in: Mapping[str, Collection[str]]) -> None:
        """Check comparisons and labels against the variants of each setting.

        Args:
            variants_in: setting to the variants that run in it.

        Raises:
            InputError: two compared variants share no setting, or two variants of a setting have one label.
        """
        for pair in self.comparisons or []:
            if not any({*pair} <= {*variants} for variants in variants_in.values()):
                raise InputError(f"{pair[0]} and {pair[1]} cannot be compared: they run in no setting together.")
        for setting, variants in variants_in.items():
            if twice := [label for label, n in Counter(map(self.label, variants)).items() if n > 1]:
                raise InputError(f"Two variants in the setting '{setting}' have the label '{twice[0]}'.")

    def label(self, name: str) -> str:
        """The name in tables."""
        return self.labels.get(name, name)

    def rank(self, variant: str) -> int:
        """Place of a variant in `order`; equal for all variants that it does not name."""
        return self.order.index(variant) if variant in self.order else len(self.order)


def _check_known(what: str, given: Iterable[str], known: Collection[str]) -> None:
    for name in given:
        if name not in known:
            raise InputError(f"Unknown {what} '{name}'; the study has: {', '.join(known)}.")
