"""``velfield bench detection``: speed of the detectors."""

from flows.options import parse_frame_size


def detection(*, size: str = "2560x1920") -> int:
    """Times of the CNN and the paper's dense response on one core, each beside a plain peer.

    Parameters
    ----------
    size
        Frame size, WxH in pixels.
    """
    from velfield.bench.detection import city, cnn_speed, response_speed
    from velfield.detection.registry import shipped_detector

    image = city(*parse_frame_size(size, "128 or more each, as 2560x1920", min_px=128))
    for speed in response_speed(image):
        print(speed.text())
    print(cnn_speed(image, shipped_detector()).text())
    return 0
