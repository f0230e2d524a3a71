"""The network's layers and its weights.

A small fully convolutional encoder-decoder: the encoder halves the resolution four times, residual blocks work at an
eighth and a sixteenth of it, and the decoder returns by depth-to-space with skip connections, as in a U-Net. `TOPOLOGY`
is the one definition of the layers: training, the ONNX graph and the detector file derive from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from schemas.arrays import Float32Array


@dataclass(frozen=True)
class Conv:
    """A convolution with bias, by default with a ReLU after it.

    A kernel of 1 or 3 keeps the resolution; one of 4 halves it (stride 2, one pixel of padding).
    """

    name: str
    kernel: Literal[1, 3, 4]
    channels_in: int
    channels_out: int
    relu: bool = True

    @property
    def stride(self) -> int:
        """2 of a kernel of 4, else 1."""
        return 2 if self.kernel == 4 else 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the weights: kernel taps, channels in, channels out."""
        return self.kernel**2, self.channels_in, self.channels_out


@dataclass(frozen=True)
class SpaceToDepth:
    """Half the resolution, four times the channels."""


@dataclass(frozen=True)
class DepthToSpace:
    """Twice the resolution, a quarter of the channels."""


@dataclass(frozen=True)
class Residual:
    """Adds the output of its layers to their input, optionally with a ReLU after the sum."""

    layers: tuple["Layer", ...]
    relu: bool = False


Layer: TypeAlias = Conv | SpaceToDepth | DepthToSpace | Residual
Topology: TypeAlias = tuple[Layer, ...]

TOPOLOGY: Topology = (
    Conv("stem", 4, 1, 16),
    Conv("down1", 4, 16, 32),
    Conv("enc1", 3, 32, 32),
    Residual(
        (
            SpaceToDepth(),
            Conv("down2", 1, 128, 48),
            Residual((Conv("res1_0", 3, 48, 48), Conv("res1_1", 3, 48, 48))),
            Residual(
                (
                    SpaceToDepth(),
                    Conv("down3", 1, 192, 96),
                    Residual((Conv("res3_0", 3, 96, 96), Conv("res3_1", 3, 96, 96))),
                    Conv("up2", 1, 96, 192, relu=False),
                    DepthToSpace(),
                ),
                relu=True,
            ),
            Residual((Conv("res2_0", 3, 48, 48), Conv("res2_1", 3, 48, 48))),
            Conv("up1", 1, 48, 128, relu=False),
            DepthToSpace(),
        ),
        relu=True,
    ),
    Conv("dec1", 3, 32, 32),
    Conv("head", 1, 32, 12, relu=False),
    DepthToSpace(),
)
"""Half the resolution and back, twice, with skip connections, between an encoder and a decoder. No layer works at full
resolution: 19.8 GMAC a frame of 2560 x 1920."""
STRIDE = 2
"""Working px a pixel of the heatmap."""
SIZE_SOURCE, SIZE_LAYER = "dec1", Conv("size", 1, 32, 4, relu=False)
"""A layer of its own on the output of another layer: the logarithms of length and width over `USUAL_SIZE_PX`, and the
logarithms of their standard deviations. It is fitted to a network that detects (`tools.sizes`), and leaves the
detections as they are."""
SIZE_STRIDE = 4
"""Working px a pixel of the sizes."""
USUAL_SIZE_PX = 16.0, 7.2
"""Length and width of a usual car, working px."""
ALIGNMENT = 16
"""Height and width of an image must be multiples of this: two to the number of halvings."""


def convolutions(layers: Topology) -> dict[str, Conv]:
    """The layers that have weights, by name, from input to output."""
    found: dict[str, Conv] = {}
    for layer in layers:
        if isinstance(layer, Conv):
            found[layer.name] = layer
        elif isinstance(layer, Residual):
            found |= convolutions(layer.layers)
    return found


LAYERS = convolutions(TOPOLOGY) | {SIZE_LAYER.name: SIZE_LAYER}
"""All layers that have weights, by name."""


@dataclass(frozen=True)
class Network:
    """Weights of a trained network: of `TOPOLOGY`, and perhaps of `SIZE_LAYER`."""

    weights: Mapping[str, Float32Array]
    """By layer, float32 (kernel taps, channels in, channels out)."""
    biases: Mapping[str, Float32Array]
    """By layer, float32 (channels out,)."""

    @property
    def measures(self) -> bool:
        """Whether it has the layer that gives lengths and widths."""
        return SIZE_LAYER.name in self.weights
