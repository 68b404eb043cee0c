"""What is found wrong with photographs: one line to read, and the same for programs."""

import dataclasses
from collections.abc import Mapping, Sequence


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that is wrong."""

    kind: str  # a word or two that name it, the same for all of its kind
    text: str  # what is wrong, and what to do about it
    # the names of the photographs it is about; empty if it is about all
    files: tuple[str, ...] = ()
    # what was measured, by file or by name
    figures: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def record(self) -> dict[str, object]:
        """JSON values."""
        figures = {name: round(float(n), 4) for name, n in self.figures.items()}
        return {**dataclasses.asdict(self), "files": [*self.files], "figures": figures}


def by_file(
    kind: str, values: Mapping[str, float], shown: str, text: str
) -> list[Finding]:
    """One finding about the files that have a value; none where no file has.

    Files and their values, written as `shown`, such as `"{:.0%}"`, go where `text` has
    `{}`.
    """
    if not values:
        return []
    listed = some([f"{name} {shown.format(value)}" for name, value in values.items()])
    return [Finding(kind, text.format(listed), tuple(values), values)]


def some(items: Sequence[str], limit: int = 4) -> str:
    """The first of a list, and how many more there are."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(items[:limit]) + more
