"""Appearance of vehicles from above: stacked layers, which give parallax of roofs and windows."""

import numpy as np

from schemas.arrays import FloatArray

BODY, GLASS, SIDE, SECOND, DARK = 0.0, 1.0, 2.0, 3.0, 4.0
"""Index of a layer's tone among the vehicle's tones."""

LAYERS = np.array(
    [
        # fraction of the height; rear and front end, of the length; half width and corner radius, of the width; tone
        [  # a car: roof, windows, bonnet and boot, sides, wheels
            [1.00, -0.27, 0.10, 0.40, 0.20, BODY],
            [0.84, -0.40, 0.24, 0.44, 0.16, GLASS],
            [0.62, -0.50, 0.50, 0.50, 0.25, BODY],
            [0.38, -0.50, 0.50, 0.50, 0.25, SIDE],
            [0.14, -0.47, 0.47, 0.49, 0.15, DARK],
        ],
        [  # a van: long roof, windscreen, short bonnet
            [1.00, -0.48, 0.20, 0.45, 0.12, BODY],
            [0.80, -0.49, 0.33, 0.47, 0.12, GLASS],
            [0.55, -0.50, 0.50, 0.50, 0.20, BODY],
            [0.30, -0.50, 0.50, 0.50, 0.20, SIDE],
            [0.12, -0.47, 0.47, 0.49, 0.10, DARK],
        ],
        [  # a lorry: box, gap, cab
            [1.00, -0.50, 0.22, 0.50, 0.03, SECOND],
            [0.82, 0.27, 0.47, 0.48, 0.10, BODY],
            [0.60, 0.27, 0.50, 0.48, 0.10, GLASS],
            [0.45, -0.50, 0.22, 0.50, 0.03, SIDE],
            [0.20, -0.48, 0.48, 0.45, 0.03, DARK],
        ],
        [  # a bus: roof, a hatch on it
            [1.02, -0.30, -0.12, 0.30, 0.05, SECOND],
            [1.00, -0.50, 0.50, 0.48, 0.08, BODY],
            [0.70, -0.50, 0.50, 0.50, 0.06, GLASS],
            [0.40, -0.50, 0.50, 0.50, 0.06, SIDE],
            [0.12, -0.48, 0.48, 0.48, 0.05, DARK],
        ],
    ]
)
"""(shape, layer, 6), highest layer first."""

PAINTS = np.array([[24, 42], [44, 72], [82, 108], [114, 158], [176, 204]], dtype=np.float64)
"""Ranges of paint, grey levels: black, dark, as the road, silver, white."""
PAINT_PROBABILITIES = np.array([0.2, 0.18, 0.12, 0.26, 0.24])


def draw_tones(n: int, rng: np.random.Generator) -> FloatArray:
    """Tones (n, 5) of n vehicles in the order BODY, GLASS, SIDE, SECOND, DARK, grey levels."""
    low, high = PAINTS[rng.choice(len(PAINTS), size=n, p=PAINT_PROBABILITIES)].T
    body = rng.uniform(low, high)
    glass = rng.uniform(28, 52, n)
    second = np.where(rng.uniform(size=n) < 0.6, rng.uniform(185, 225, n), rng.uniform(60, 150, n))
    return np.column_stack([body, glass, 0.62 * body, second, np.full(n, 22.0)])
