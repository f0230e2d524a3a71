"""How much of a map is known, and by how many vehicles, in words."""

_SEEN_WELL = 0.05
"""Below this share of pixels that five vehicles passed, a map of speeds is one of single vehicles."""


def few_vehicles(pixels: int, pixels_5: int) -> str:
    """What is to be said of a field where hardly any pixel was passed by five vehicles; nothing of any other.

    Parameters
    ----------
    pixels, pixels_5
        Pixels that a vehicle passed, and those that 5 or more did.

    Examples
    --------
    >>> few_vehicles(55251, 1105).partition(".")[0]
    '2 % of the known pixels were passed by 5 or more vehicles'
    >>> few_vehicles(55251, 20000), few_vehicles(0, 0)
    ('', '')
    """
    if pixels_5 >= _SEEN_WELL * pixels:
        return ""
    share = f"{percent(pixels_5, pixels)} of the known pixels were" if pixels_5 else "No pixel was"
    return (
        f"{share} passed by 5 or more vehicles. Directions hold; speeds and percentiles are those of single vehicles. "
        "Fly longer, or add flights up."
    )


def percent(part: float, whole: float) -> str:
    """A share as people say it, two digits of it at least where it is small.

    Examples
    --------
    >>> percent(55251, 2089710), percent(3, 4), percent(0, 4), percent(1, 10000), percent(0, 0)
    ('2.6 %', '75 %', '0 %', '0.01 %', '0 %')
    """
    share = 100 * part / whole if whole else 0.0
    return f"{share:.0f} %" if share >= 9.95 or share == 0 else f"{share:.2g} %"
