"""Coverage of a map by vehicles, in words."""

_MIN_FRACTION_5 = 0.05
"""Below this fraction of pixels with five tracks, a map of speeds is one of single vehicles."""


def low_coverage_note(pixels: int, pixels_5: int) -> str:
    """A note on a field where few pixels have five tracks; empty for any other.

    Parameters
    ----------
    pixels, pixels_5
        Numbers of pixels with one track or more, and with 5 or more.

    Examples
    --------
    >>> low_coverage_note(55251, 1105).partition(".")[0]
    '2 % of the known pixels were passed by 5 or more vehicles'
    >>> low_coverage_note(74722, 12).partition(".")[0]
    '12 of 74722 known pixels were passed by 5 or more vehicles'
    >>> low_coverage_note(55251, 20000), low_coverage_note(0, 0)
    ('', '')
    """
    if pixels_5 >= _MIN_FRACTION_5 * pixels:
        return ""
    fraction = f"{percent(pixels_5, pixels)} of the known pixels were" if pixels_5 else "No pixel was"
    if 0 < pixels_5 < 0.01 * pixels:
        fraction = f"{pixels_5} of {pixels} known pixels {'was' if pixels_5 == 1 else 'were'}"
    return (
        f"{fraction} passed by 5 or more vehicles. Where fewer passed, directions and speeds are those of single "
        "vehicles, and of what was taken for one. Record for longer, or merge several flights."
    )


def percent(part: float, whole: float) -> str:
    """A fraction in per cent, with two significant digits below 10 %.

    Examples
    --------
    >>> percent(55251, 2089710), percent(3, 4), percent(0, 4), percent(1, 10000), percent(0, 0)
    ('2.6 %', '75 %', '0 %', '0.01 %', '0 %')
    """
    value = 100 * part / whole if whole else 0.0
    return f"{value:.0f} %" if value >= 9.95 or value == 0 else f"{value:.2g} %"
