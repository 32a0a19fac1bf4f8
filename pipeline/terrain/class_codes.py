"""Class codes: what the numbers in a file's classification mean, where they are not those of ASPRS.

Producers have codes of their own (67 for a building, say). They are turned into ASPRS codes where points are read, so
that every stage knows one set only.
"""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter

OTHER = 255
"""What an ASPRS code becomes that the user took from its group: no ground, no building, not undecided."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassCodeSettings(Parameters):
    """Which codes of the file mean what; a code in no list can be no roof where classes are believed."""

    ground: tuple[int, ...] = parameter((2,), "Codes that mean ground.", minimum=0, maximum=255)
    building: tuple[int, ...] = parameter((6,), "Codes that mean building.", minimum=0, maximum=255)
    vegetation: tuple[int, ...] = parameter((3, 4, 5), "Codes that mean vegetation.", minimum=0, maximum=255)
    noise: tuple[int, ...] = parameter(
        (7, 18), "Codes that mean noise: such points are left out, whatever `classes` says.", minimum=0, maximum=255
    )
    undecided: tuple[int, ...] = parameter(
        (0, 1, 12, 19), "Codes that say nothing: such points are judged by their own evidence.", minimum=0, maximum=255
    )

    def cross_faults(self) -> list[str]:
        """A code means one thing."""
        groups: dict[int, list[str]] = {}
        for name, codes in dataclasses.asdict(self).items():
            for code in dict.fromkeys(codes) if isinstance(codes, tuple) else ():
                groups.setdefault(code, []).append(name)
        return [
            f"code {code} is {' and '.join(names)}: give it in one list"
            for code, names in sorted(groups.items())
            if len(names) > 1
        ]

    @property
    def table(self) -> tuple[int, ...] | None:
        """The ASPRS code of each of the 256 codes; None where all keep their own meaning.

        >>> ClassCodeSettings().table is None
        True
        >>> table = ClassCodeSettings(building=(67,)).table
        >>> table[67], table[6], table[9]
        (6, 255, 9)
        """
        asprs: dict[str, tuple[int, ...]] = dataclasses.asdict(ClassCodeSettings())
        table = list(range(256))
        for codes in asprs.values():
            for code in codes:
                table[code] = OTHER
        for name, codes in asprs.items():
            for code in getattr(self, name):
                table[code] = code if code in codes else codes[0]
        return None if table == list(range(256)) else tuple(table)
