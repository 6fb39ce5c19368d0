"""What the numbers of a raster mean: its scale, offset and unit, and numbers that stand for no data undeclared."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.errors import MapError
from planner.shown import counted

LOWEST, HIGHEST = -12_000.0, 9_000.0
"""Metres: no ground on Earth lies below or above."""
FILL = (-9999, -99999, -999999, -32767, -32768, -(2**31), -(2**63))
"""Numbers that files hold where nothing is known, whatever the type of their numbers."""
OWN_FILL = {True: -10_000, False: -999}
"""One more where none is declared: of heights (True), and of all else; a sea may be 999 m deep."""
NEAR = 1.0
"""How far from the first of FILL a number may be: -9999.9 and -9999.25 are in use."""
HUGE = 1e20
"""Magnitude from which a finite number stands for no data: 1e20, 9.97e36, and the largest float32 and float64."""
MOST_NAMED = 2
"""Different numbers that a note names one by one."""
SAME_UNIT = 1e-5
"""Relative difference of two units up to which they count as one: a foot and a US survey foot differ by 2e-6."""
NO_UNIT = ("", "none", "unknown", "n a")

METRE = {"": 1.0, "deci": 0.1, "centi": 0.01, "milli": 0.001, "kilo": 1000.0}
LENGTHS = {
    **dict.fromkeys(NO_UNIT, 1.0),
    **{f"{prefix}{metre}": size for prefix, size in METRE.items() for metre in ("metre", "metres", "meter", "meters")},
    **{f"{prefix[:1]}m": size for prefix, size in METRE.items()},
    **dict.fromkeys(("ft", "foot", "feet", "international foot", "international feet", "ft int", "intl ft"), 0.3048),
    **{
        f"{before}{foot}{after}": 1200 / 3937
        for foot in ("foot", "feet", "ft")
        for before, after in (
            ("us survey ", ""), ("survey ", ""), ("us ", ""), ("us", ""), ("", "us"), ("", " us"), ("", " us survey"),
        )
    },
    **dict.fromkeys(("yd", "yard", "yards"), 0.9144),
    **dict.fromkeys(("fathom", "fathoms"), 1.8288),
}  # fmt: skip
"""Metres of each unit of height, by its name in small letters without punctuation (`plain`)."""
SHARES = {
    **dict.fromkeys(NO_UNIT, 1.0),
    **dict.fromkeys(("1", "0 1", "unity", "unitless", "dimensionless", "fraction", "ratio"), 1.0),
    **dict.fromkeys(("probability", "probabilities", "chance", "p"), 1.0),
    **dict.fromkeys(("%", "percent", "per cent", "percents", "percentage", "pct"), 0.01),
    **dict.fromkeys(("‰", "per mille", "permille", "promille", "per mil", "permil", "per thousand"), 0.001),
    **dict.fromkeys(("ppm", "parts per million"), 1e-6),
}
"""Of each unit of a probability, likewise."""


class Meaning(NamedTuple):
    """What the numbers of a raster are taken for.

    Attributes:
        name: in words.
        units: factor of each unit that is understood, by its plain name; None: any unit will do.
        expected, fix: for the error on another unit.
    """

    name: str
    units: Mapping[str, float] | None = None
    expected: str = ""
    fix: str = ""


PROBABILITIES = Meaning(
    "probabilities", SHARES, "no unit, 1, percent, per mille or ppm",
    "heights are given as `map: {elevation: ...}`, measured values by `raster:` and a `rule`",
)  # fmt: skip
HEIGHTS = Meaning(
    "heights", LENGTHS, "m, dm, cm, mm, km, ft, US survey foot, yard or fathom", "convert it, or correct its unit"
)
AMOUNTS = Meaning("amounts")
"""Measured values, which a rule makes probabilities of, and values of cells: in any unit."""


class Unit(NamedTuple):
    """The unit of heights that a coordinate reference system names: metres of one; negative: depths, downwards."""

    name: str
    size: float


class Said(NamedTuple):
    """What a file says about its numbers: value = scale * number + offset, in `unit`.

    Attributes:
        vertical: the unit of heights of its coordinate reference system, or None.
        fill: numbers that its metadata name as no data, but no reader masks.
        declared: whether it declares no data in a way that readers know.
    """

    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    vertical: Unit | None = None
    fill: tuple[float, ...] = ()
    declared: bool = False


class Physical(NamedTuple):
    """Values float64 `[H, W]` (NaN = no data), notes, and what undeclared voids there are, in words ("": none)."""

    values: NDArray[np.float64]
    notes: tuple[str, ...]
    voids: str


def plain(unit: str) -> str:
    """A unit's name in small letters, without punctuation: `U.S. survey foot` and `us-survey-foot` are one."""
    words = re.sub(r"[\s._()\[\]-]+", " ", unit.casefold()).strip()
    return re.sub(r" (above|asl|a s l|amsl|msl|over)( .*)?$", "", re.sub(r"\bu s\b", "us", words))


def physical(raw: NDArray, known: NDArray[np.bool_], said: Said, of: Meaning, source: str) -> Physical:
    """The numbers `raw` `[H, W]` of a file, where they are `known`, as values: probabilities 0..1, metres, amounts.

    Numbers that look like no data but are not declared so are NaN too (`Physical.voids`). Raises MapError for a unit
    that is not understood, and a scale that is no number.
    """
    if not (math.isfinite(said.scale) and math.isfinite(said.offset) and said.scale != 0):
        problem = f"says that its values are {said.scale:g} * number + {said.offset:g}"
        raise MapError(problem, source=source, expected="a finite scale other than 0, and a finite offset")
    factor, unit_notes = _factor(said, of, source)
    is_scaled = (said.scale, said.offset) != (1, 0)
    with np.errstate(over="ignore", invalid="ignore"):  # long doubles; infinite numbers
        numbers = raw.astype(np.float64)
        scaled = numbers * said.scale + said.offset if is_scaled else numbers
        values = scaled / (1 / factor) if factor != 1 else scaled  # by 100 if percent: 7 % are 0.07 to the last bit
    void = known & _voids(raw, (numbers, scaled, values), said, of)
    notes = unit_notes
    if is_scaled:
        added = f" + {said.offset:g}" if said.offset else ""
        notes = (f"as the file says, its values are {said.scale:g} * number{added}", *notes)
    return Physical(np.where(known & ~void, values, np.nan), notes, _describe(numbers[void], of, source))


def _factor(said: Said, of: Meaning, source: str) -> tuple[float, tuple[str, ...]]:
    """What the values are multiplied by, and notes."""
    name, vertical = plain(said.unit), said.vertical
    own = None if vertical is None else plain(vertical.name)
    if of is not HEIGHTS and name == own:
        name = ""  # GDAL passes the vertical unit of the CRS on as that of every band
    if of.units is None:
        return 1.0, () if name in NO_UNIT else (f"its values are in {said.unit}",)
    if of is HEIGHTS and vertical is not None:
        size = of.units.get(name) if name not in (own, *NO_UNIT) else abs(vertical.size)
        if size is None or abs(size / abs(vertical.size) - 1) > SAME_UNIT:
            problem = f"its heights are in {said.unit!r}, but its CRS counts heights in {vertical.name!r}"
            raise MapError(problem, source=source, expected="one unit", fix=of.fix)
        return vertical.size, _unit_note(vertical.name, vertical.size)
    factor = of.units.get(name)
    if factor is None and of is PROBABILITIES and re.fullmatch(r"[0-9.]+(e-?[0-9]+)?", said.unit.strip().casefold()):
        factor = float(said.unit)  # as UDUNITS writes percent: 0.01
    if not factor:
        problem = f"its values are in {said.unit!r}, taken for {of.name}"
        raise MapError(problem, source=source, expected=of.expected, fix=of.fix)
    return factor, _unit_note(said.unit, factor) if of is HEIGHTS else ()


def _unit_note(unit: str, size: float) -> tuple[str, ...]:
    if size == 1:
        return ()
    return (f"its heights are in {unit}, {size:.7g} m each" if size > 0 else f"its values are depths, in {unit}",)


def _voids(raw: NDArray, stages: tuple[NDArray[np.float64], ...], said: Said, of: Meaning) -> NDArray[np.bool_]:
    """bool `[H, W]`: numbers that stand for no data. `stages`: the file's numbers, scaled, and in the unit of `of`."""
    numbers, scaled, values = stages
    void = (np.abs(numbers) >= HUGE) & np.isfinite(numbers)
    fill = FILL if said.declared else (*FILL, OWN_FILL[of is HEIGHTS])
    for stage in {id(stage): stage for stage in (numbers, scaled, values)}.values():
        low = stage < max(fill) + NEAR
        if low.any():
            void[low] |= np.isin(stage[low], fill) | (np.abs(stage[low] - FILL[0]) < NEAR)
    if raw.dtype.kind in "iu" and not said.declared and (raw.dtype.itemsize > 1 or of is PROBABILITIES):
        void |= numbers == float(np.iinfo(raw.dtype).max)
    if of is HEIGHTS:
        void |= (values < LOWEST) | (values > HIGHEST)
    if of is PROBABILITIES:
        void &= (values < 0) | (values > 1)
    return void | np.isin(numbers, said.fill)


def _describe(numbers: NDArray[np.float64], of: Meaning, source: str) -> str:
    """Voids in words, by their numbers in the file; "" where there are none."""
    if not numbers.size:
        return ""
    which = np.unique(numbers)
    many = len(which) > MOST_NAMED
    named = f"{which[0]:.7g} .. {which[-1]:.7g}" if many else ", ".join(f"{number:.7g}" for number in which)
    what = "a mark of no data" + ", or no height on Earth" * (of is HEIGHTS)
    fix, first = "write nan there", f"{which[0]:.17g}"
    if source.casefold().endswith((".tif", ".tiff", ".asc")):
        is_text = source.casefold().endswith(".asc")
        fix = f"declare it: {f'NODATA_value {first} in its header' if is_text else edited(source, '--nodata', first)}"
        fix += " (or another, if these are values)" * (of is not HEIGHTS)
    if many and of is HEIGHTS:
        fix = f"declare them, or their unit if they are no metres, as in {edited(source, '--units', 'cm')}"
    return f"{counted(numbers.size, 'pixel')} of {named}, {what}, count as no data though none is declared; {fix}"


def edited(source: str, option: str, value: str) -> str:
    """The command of rasterio that sets what a GeoTIFF says of itself."""
    name = re.split(r"[\\/]", source)[-1]
    return f"`rio edit-info {option} {value} {name}`"
