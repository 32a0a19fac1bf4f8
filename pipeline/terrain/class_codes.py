"""Class codes: the meaning of the numbers in a file's classification, if they are not those of ASPRS.

Producers have their own codes (67 for a building, for example). They become ASPRS codes when points are read: every
stage knows only one set.
"""

from __future__ import annotations

import dataclasses

from pipeline.parameters import Parameters, parameter

OTHER = 255
"""Replaces a producer's own code for other things, and an ASPRS code that the user took out of its list."""


class ClassCodeSettings(Parameters):
    """Meaning of the codes in the file; points with a code in no list are undecided."""

    ground: tuple[int, ...] = parameter((2,), "Codes that mean ground.", minimum=0, maximum=255)
    building: tuple[int, ...] = parameter((6,), "Codes that mean building.", minimum=0, maximum=255)
    vegetation: tuple[int, ...] = parameter((3, 4, 5), "Codes that mean vegetation.", minimum=0, maximum=255)
    noise: tuple[int, ...] = parameter(
        (7, 18), "Codes that mean noise: such points are left out for any value of `classes`.", minimum=0, maximum=255
    )
    undecided: tuple[int, ...] = parameter(
        (0, 1, 12, 19),
        "Codes without information: such points are judged by their own evidence, as are points with codes in no list.",
        minimum=0,
        maximum=255,
    )
    other: tuple[int, ...] = parameter(
        (8, 9, 10, 11, 13, 14, 15, 16, 17, 20, 21, 22, 26, OTHER),
        "Codes of other things, such as water, roads, wires and bridges (26 in the Netherlands), which are never roof.",
        minimum=0,
        maximum=255,
    )

    @classmethod
    def role(cls, code: int) -> str:
        """What an ASPRS code means to a run: the name of its list, or `undecided`.

        >>> [ClassCodeSettings.role(code) for code in (2, 6, 9, 28, OTHER)]
        ['ground', 'building', 'other', 'undecided', 'other']
        """
        lists: dict[str, tuple[int, ...]] = dataclasses.asdict(cls())
        return next((name for name, codes in lists.items() if code in codes), "undecided")

    def cross_faults(self) -> list[str]:
        """A code means one thing; the default of `other` gives way to other lists."""
        groups: dict[int, list[str]] = {}
        for name, codes in dataclasses.asdict(self).items():
            is_default = name == "other" and codes == type(self).__dataclass_fields__["other"].default
            for code in dict.fromkeys(codes) if isinstance(codes, tuple) and not is_default else ():
                groups.setdefault(code, []).append(name)
        return [
            f"code {code} is {' and '.join(names)}: give it in one list"
            for code, names in sorted(groups.items())
            if len(names) > 1
        ]

    @property
    def table(self) -> tuple[int, ...] | None:
        """The ASPRS code of each of the 256 codes; None if all keep their own meaning.

        >>> ClassCodeSettings().table is None
        True
        >>> table = ClassCodeSettings(building=(67,)).table
        >>> table[67], table[6], table[9], table[28]
        (6, 255, 9, 28)
        """
        asprs: dict[str, tuple[int, ...]] = dataclasses.asdict(ClassCodeSettings())
        table = list(range(256))
        for codes in asprs.values():
            for code in codes:
                table[code] = OTHER
        # `other` first, whose default gives way to other lists
        for name, codes in reversed(asprs.items()):
            for code in getattr(self, name):
                table[code] = code if code in codes else OTHER if name == "other" else codes[0]
        return None if table == list(range(256)) else tuple(table)
