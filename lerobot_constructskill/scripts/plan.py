"""`constructskill-plan`: show a plan, check it, or make one of an IFC file."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_constructskill.artifacts.folders import replaced
from lerobot_constructskill.bounds import Checked
from lerobot_constructskill.errors import InputError, TakenError, plural
from lerobot_constructskill.plans.plan import Plan, read_plan, written
from lerobot_constructskill.scripts.console import command

MADE = "# Made of "
"""How the file of a plan begins that was made of an IFC file."""


@dataclass
class PlanConfig(Checked):
    """Check a plan, a list of elements that a wall is laid of, and draw it.

    Build it with `--env.type=constructskill --env.plan=NAME_OR_FILE`; other commands take `--task=plan:NAME_OR_FILE`.
    """

    plan: str  # a name in `configs/plan`, a file of YAML, or an IFC file that ends in .ifc
    picture: Path | None = None  # where to draw it, .png or .svg; default: nowhere
    out: Path | None = None  # where to write the plan of an IFC file, .yaml
    origin: list[float] | None = None  # x and y (m) of an IFC file's first element; default: where the model has it

    def __post_init__(self):
        super().__post_init__()
        for name, endings in (("picture", (".png", ".svg")), ("out", (".yaml",))):
            path = getattr(self, name)
            if path is not None and path.suffix not in endings:
                raise InputError(f"{name} must be a file that ends in {' or '.join(endings)}, not '{path}'.")
        if self.origin is not None and len(self.origin) != 2:
            raise InputError(f"origin must be two numbers, x and y in metres, not {self.origin}.")
        if (is_ifc := self.plan.lower().endswith(".ifc")) != (self.out is not None):
            raise InputError(
                "A plan of an IFC file needs --out=PLAN.yaml, where it is written."
                if is_ifc
                else f"out is for the plan of an IFC file; '{self.plan}' is a plan already."
            )


@command("constructskill-plan bond_of_five --picture=outputs/bond.png", first=("plan",))
def plan(config: PlanConfig) -> str:
    """Say how many elements a plan has and whether it can be built; draw it or write it where that was asked for.

    Raises:
        MissingError: there is no such plan, or IfcOpenShell is not installed.
        InputError: it is no plan, or cannot be built; every reason is told.
        TakenError: there is a file at `out` that was not made of an IFC file.
    """
    from lerobot_constructskill.plans.check import complaints

    read = _of_ifc(config, config.out) if config.out else read_plan(config.plan)
    if config.picture:
        from lerobot_constructskill.plans.picture import draw_plan

        with replaced(config.picture) as partial:
            draw_plan(read, config.plan, partial)
    made = f" It was written to {config.out}." if config.out else ""
    if found := list(complaints(read)):
        raise InputError(" ".join(found) + made)
    drawn = f" It is drawn in {config.picture}." if config.picture else ""
    return f"{config.plan}: {plural(len(read.elements), 'element')}, can be built by this robot.{made}{drawn}"


def _of_ifc(config: PlanConfig, out: Path) -> Plan:
    """Write the plan of an IFC file and read it."""
    from lerobot_constructskill.plans.ifc import plan_of

    if out.exists() and not out.read_bytes().startswith(MADE.encode()):
        raise TakenError(f"{out} exists and was not made of an IFC file: name another with --out.")
    facts = plan_of(Path(config.plan), (config.origin[0], config.origin[1]) if config.origin else None)
    with replaced(out) as partial:
        partial.write_text(f"{MADE}{Path(config.plan).name}.\n{written(facts)}", encoding="utf-8")
    return read_plan(str(out))
