"""How a number of things is told."""


def count_of(number: int, what: str) -> str:
    """A number and what it is of, which has an s at its end where there is not one of it.

    Examples:
        >>> count_of(1, "tile"), count_of(2000, "sample point")
        ('1 tile', '2,000 sample points')
    """
    return f"{number:,} {what}{'' if number == 1 else 's'}"
