"""Paths with patterns in them: what is there is taken by its name, whatever signs that has."""

from glob import escape, glob, has_magic
from pathlib import Path


def paths_of(pattern: str) -> list[str]:
    """What a path or a pattern names, sorted; nothing: nothing of that name is there.

    A file or folder that is there is meant by its name: of `[1]/*.pcd`, where a folder `[1]` is
    there, what lies in it. `**` goes through folders.

    Examples:
        >>> paths_of("street.pcd"), paths_of("[s]treet.pcd"), paths_of("gone.pcd")
        (['street.pcd'], ['street.pcd'], [])
    """
    if Path(pattern).exists():
        return [pattern]
    if not has_magic(pattern):
        return []
    begin, rest = Path(), list(Path(pattern).parts)
    while len(rest) > 1 and (begin / rest[0]).is_dir():
        begin /= rest.pop(0)
    literal = "" if begin == Path() else escape(str(begin))
    return sorted(glob(str(Path(literal, *rest)), recursive=True))  # noqa: PTH207 - of any folder
