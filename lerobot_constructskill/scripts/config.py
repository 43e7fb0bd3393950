"""`constructskill-config`: list this package's configurations, or print the path of one, for `lerobot-train`."""

from lerobot_constructskill.errors import MissingError
from lerobot_constructskill.presets import KINDS, description, find, names
from lerobot_constructskill.scripts.console import EPILOG, Parser, edge


def show(name: str | None = None) -> str:
    """The path of a configuration such as `train/act`; without a name, a line for each of them.

    Raises:
        MissingError: there is no such configuration.
    """
    shipped = {f"{kind}/{one}": find(kind, one) for kind in KINDS for one in names(kind)}
    if name is None:
        width = max(map(len, shipped))
        return "\n".join(f"{one:<{width}}  {description(path)}" for one, path in shipped.items())
    if name not in shipped:
        raise MissingError(f"There is no configuration '{name}'; the configurations are: {', '.join(shipped)}.")
    return str(shipped[name])


def main() -> None:
    parser = Parser(
        prog="constructskill-config",
        description="Print the path of a shipped configuration, or list them all. "
        "As in: lerobot-train --config_path=$(constructskill-config train/act)",
        epilog=EPILOG,
    )
    parser.add_argument("name", nargs="?", help=f"{'/NAME, '.join(KINDS)}/NAME; all are listed without it")
    with edge():
        print(show(parser.parse_args().name))


if __name__ == "__main__":
    main()
