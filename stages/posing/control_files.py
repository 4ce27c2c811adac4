"""Ground control as people write it down: points with known coordinates, and where photos show them.

One table with a row for each sighting (name, x, y, z, photo, px, py), OpenDroneMap's `gcp_list.txt`, or two tables, one
of the points and one of the sightings, in a folder. Columns are known by their names, whatever their order; without
names, by what is in them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.errors import InputError
from stages.inputs.bounded import MOST_TEXT, read_bytes, reason

CONTROL = "control points"  # what a run calls this input
SUFFIXES = frozenset({".csv", ".txt", ".tsv", ".gcp"})
FORM = "It needs rows of name, x, y, z, photo, px, py with these names above them, or is OpenDroneMap's gcp_list.txt."
COLUMNS = {
    "name": "name label point pointname pointid id gcp gcpname marker markername",
    "x": "x east easting e geox lon long longitude xeast xeasting xlongitude",
    "y": "y north northing n geoy lat latitude ynorth ynorthing ylatitude",
    "z": "z up height h alt altitude elevation ele geoz zaltitude zheight zelevation ellipsoidalheight",
    "photo": "photo image picture file filename imagename photoname imagefile camera",
    "px": "px u imx imagex pixelx xpixel xpx col column xprojection",
    "py": "py v imy imagey pixely ypixel ypx row line yprojection",
    "role": "role type check checkpoint kind",
}
KNOWN = {name: column for column, names in COLUMNS.items() for name in names.split()}
DEGREES = {"lon", "long", "longitude", "lat", "latitude", "xlongitude", "ylatitude"}
CHECK_WORDS = {"check", "checkpoint", "check point", "chk", "1", "true", "yes", "y"}
CHECK_NAME = re.compile(r"^(check|chk)", re.IGNORECASE)
PHOTO_NAME = re.compile(r"\.[a-z]\w{2,4}$", re.IGNORECASE)
NUMBER = re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?$")
DECIMAL_COMMA = re.compile(r"^[-+]?\d+,\d+$")
GEOGRAPHIC = "EPSG:4326"
LONGEST_LINE = 10_000  # characters; a coordinate system in words has 3000
LARGEST = 1e9  # of a coordinate or a pixel; the Earth is 4e7 metres around


@dataclass(frozen=True)
class KnownPoint:
    """A point whose coordinates are known.

    Attributes:
        xyz: as the file has them: east (or longitude), north (or latitude), up.
        check: whether it only checks the result, and takes no part in it.
    """

    name: str
    xyz: tuple[float, float, float]
    check: bool


@dataclass(frozen=True)
class Sighting:
    """Where a photo shows a point: pixels of the upright photo, (0, 0) at its upper left corner."""

    point: str
    photo: str
    pixel: tuple[float, float]


@dataclass(frozen=True)
class GroundControl:
    """All of a file, or of a folder of two.

    Attributes:
        crs: the coordinate system that it names: "EPSG:32632", a PROJ string or WKT; empty where it names none.
    """

    origin: Path
    points: tuple[KnownPoint, ...]
    sightings: tuple[Sighting, ...]
    crs: str = ""

    def system(self, code: int | None) -> str:
        """The coordinate system, where the user may have said its EPSG code."""
        return self.crs if code is None else f"EPSG:{code}"


@dataclass(frozen=True)
class _Row:
    """What a line says, column by column; `where` names it in an error."""

    values: dict[str, str]
    where: str

    def number(self, column: str) -> float:
        text = self.values.get(column, "")
        if DECIMAL_COMMA.match(text):
            raise InputError(
                f"{self.where}: {text} has a decimal comma, a point is needed.",
                "Write the table with decimal points and commas, semicolons or tabs between the columns.",
            )
        if not NUMBER.match(text) or abs(float(text)) > LARGEST:
            raise InputError(f"{self.where}: {column} is '{text[:40]}', a number is needed.", FORM)
        return float(text)


def read_control(path: Path) -> GroundControl:
    """The ground control in a file, or in all tables of a folder.

    Raises:
        InputError: it cannot be read, it names no points or no sightings, or it contradicts itself.
    """
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    crs, degrees = "", False
    rows: list[_Row] = []
    for file in files:
        lines = _lines(file)
        named, more, in_degrees = _table(lines, file)
        crs, rows, degrees = crs or named, rows + more, degrees or in_degrees
    points, sightings = _points(rows, path), _sightings(rows)
    if not points or not sightings:
        raise InputError(
            f"{path} names {len(points)} points with coordinates and {len(sightings)} pixel positions in photos.",
            FORM + " Two tables, of points and of pixel positions, go into one folder: `--control FOLDER`.",
        )
    if unknown := sorted({each.point for each in sightings} - {point.name for point in points}):
        raise InputError(f"{path} marks {unknown[0]} in a photo, but has no coordinates of it.", "Check its name.")
    return GroundControl(path, points, sightings, crs or (GEOGRAPHIC if degrees else ""))


# ---------------------------------------------------------------- tables
def _lines(file: Path) -> list[tuple[int, str]]:
    """Number and text of each line that is not empty."""
    try:
        data = read_bytes(file, MOST_TEXT)
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read: {reason(error)}.", "Check the path with `ls`.") from error
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    if data.startswith(b"PK") or (b"\0" in data and encoding != "utf-16"):
        raise InputError(f"{file} is no text.", "Write the table as CSV; spreadsheets do so with 'Save as'.")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    lines = [(number, line.strip(" ")) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if long := [number for number, line in lines if len(line) > LONGEST_LINE]:
        raise InputError(f"{file}, line {long[0]} has more than {LONGEST_LINE} characters.", FORM)
    return lines


def _table(lines: Sequence[tuple[int, str]], file: Path) -> tuple[str, list[_Row], bool]:
    """The coordinate system that is named, the rows, and whether the columns' names mean degrees."""
    crs, header, degrees = "", None, False
    rows: list[_Row] = []
    for number, line in lines:
        text = line.lstrip("#/ ").strip() if line.startswith(("#", "//")) else line
        if not rows and header is None and (found := coordinate_system(text)):
            crs = crs or found
            continue
        cells = _cells(text)
        if header is None and not rows:
            plain = [re.sub(r"[\[(][^\[(\])]*[\])]|[^a-z]", "", cell.lower()) for cell in cells]
            known = [KNOWN.get(cell) for cell in plain]
            if len({column for column in known if column}) >= 3:
                header, degrees = _pixels_apart(plain, known), any(cell in DEGREES for cell in plain)
                continue
        if text is not line or text.lower() == "local":
            continue  # a comment
        where = f"{file}, line {number}"
        columns = header or _columns_of(cells, where)
        if len(cells) > len(columns) and header is not None and any(cells[len(columns) :]):
            raise InputError(f"{where} has {len(cells)} columns, the line of names has {len(columns)}.", FORM)
        rows.append(_Row({column: cell for column, cell in zip(columns, cells, strict=False) if column}, where))
    return crs, rows, degrees


def _pixels_apart(names: Sequence[str], columns: Sequence[str | None]) -> list[str | None]:
    """The columns where "x" and "y" are pixels: beside photos, with easting and northing or without any height."""
    if "photo" not in columns or "px" in columns or (columns.count("x") < 2 and "z" in columns):
        return list(columns)
    return [{"x": "px", "y": "py"}.get(name, column) for name, column in zip(names, columns, strict=True)]


def _cells(line: str) -> list[str]:
    import csv

    delimiter = next((each for each in ("\t", ";", ",") if each in line), None)
    words = line.split()
    if delimiter is None or (delimiter == "," and any(DECIMAL_COMMA.match(word) for word in words) and len(words) > 3):
        return words
    return [cell.strip().strip("'\"") for cell in next(csv.reader([line], delimiter=delimiter))]


def _columns_of(cells: Sequence[str], where: str) -> list[str]:
    """The columns of a row without names above it, by what is in it."""
    kinds = "".join("9" if NUMBER.match(cell) or DECIMAL_COMMA.match(cell) else "a" for cell in cells)
    if re.match("^99999a", kinds):
        return ["x", "y", "z", "px", "py", "photo", "name"]
    if re.match("^.999a99", kinds):
        return ["name", "x", "y", "z", "photo", "px", "py", "role"]
    if re.match("^a.99$", kinds) and PHOTO_NAME.search(cells[0]):
        return ["photo", "name", "px", "py"]
    if re.match("^.a99$", kinds):
        return ["name", "photo", "px", "py"]
    if re.match("^.999a?$", kinds):
        return ["name", "x", "y", "z", "role"]
    raise InputError(f"{where} is not understood: {' '.join(cells)[:60]}", FORM)


def coordinate_system(text: str) -> str:
    """The coordinate system that a line names, as pyproj takes it; empty where it names none."""
    text = re.sub(r"^(coordinate\s*system|crs|srs|projection)\s*[:=]\s*", "", text.strip(), flags=re.IGNORECASE)
    if re.match(r"^(\+proj|PROJC|GEOGC|COMPD|COMPOUNDCRS|GEODCRS|GEOCCS)", text):
        return text
    if found := re.match(r"^epsg\s*[:=]*\s*(\d{4,6})\b", text, re.IGNORECASE):
        return f"EPSG:{found[1]}"
    if found := re.match(r"^wgs\s*84\s*[/ ]?\s*utm\s*(?:zone)?\s*(\d{1,2})\s*([NS])$", text, re.IGNORECASE):
        return f"EPSG:{326 if found[2].upper() == 'N' else 327}{int(found[1]):02d}"
    return GEOGRAPHIC if re.match(r"^wgs\s*84$", text, re.IGNORECASE) else ""


# ---------------------------------------------------------------- rows
def _points(rows: Sequence[_Row], path: Path) -> tuple[KnownPoint, ...]:
    found: dict[str, KnownPoint] = {}
    for row in rows:
        if not any(row.values.get(column) for column in "xyz"):
            continue
        x, y, z = (row.number(column) for column in "xyz")
        name = _name(row)
        role = row.values.get("role", "").lower()
        check = bool(CHECK_NAME.match(name)) or role in CHECK_WORDS
        known = found.setdefault(name, KnownPoint(name, (x, y, z), check))
        if known.xyz != (x, y, z):
            raise InputError(
                f"{row.where}: {name} is at {x:g} {y:g} {z:g}, before it was at "
                f"{known.xyz[0]:g} {known.xyz[1]:g} {known.xyz[2]:g}.",
                "Give each point its own name, and the same coordinates in each of its rows.",
            )
    return tuple(found.values())


def _sightings(rows: Sequence[_Row]) -> tuple[Sighting, ...]:
    found: dict[tuple[str, str], Sighting] = {}
    for row in rows:
        photo = row.values.get("photo", "").replace("\\", "/")
        if not photo or not (row.values.get("px") or row.values.get("py")):
            continue
        mark = Sighting(_name(row), photo, (row.number("px"), row.number("py")))
        if found.setdefault((mark.point, photo), mark).pixel != mark.pixel:
            raise InputError(f"{row.where}: {mark.point} is marked twice in {photo}.", "Remove one of the two.")
    return tuple(found.values())


def _name(row: _Row) -> str:
    """Its name; OpenDroneMap's lists need none, and what has the same coordinates is one point."""
    coordinates = " ".join(row.values.get(column, "") for column in "xyz").strip()
    name = row.values.get("name", "") or coordinates
    if not name:
        raise InputError(f"{row.where} does not name its point.", FORM)
    return name
