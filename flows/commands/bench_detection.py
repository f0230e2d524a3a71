"""``velfield bench detection``: how fast cars are found."""


def detection(*, size: str = "2560x1920") -> int:
    """Times of both steps and of the paper's dense response on one core, each beside a plain peer in the same run.

    Parameters
    ----------
    size
        Frame size, WxH in pixels.
    """
    from velfield.bench.detection import cascade_speed, city, response_speed
    from velfield.errors import InputError

    width, times, height = size.lower().partition("x")
    if not (times and width.isdigit() and height.isdigit() and min(int(width), int(height)) >= 128):
        raise InputError(f"--size {size}: expected WIDTHxHEIGHT in pixels, 128 or more each, as 2560x1920")
    image = city(int(width), int(height))
    for speed in (response_speed(image), cascade_speed(image)):
        print(speed.text())
    return 0
