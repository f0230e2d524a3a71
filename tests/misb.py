"""MISB ST 0601 local sets, encoded here by the standard's own formulas: what the reader of KLV is tested with."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
from scipy.spatial.transform import Rotation

from tests.media import drifting
from velfield.sources.telemetry.telemetry import Telemetry

KEY = bytes.fromhex("060E2B34020B01010E01030101000000")
# Tag: bytes, low and high end of the range, whether the integer has a sign.
_TAGS = {
    5: (2, 0.0, 360.0, False),
    6: (2, -20.0, 20.0, True),
    7: (2, -50.0, 50.0, True),
    13: (4, -90.0, 90.0, True),
    14: (4, -180.0, 180.0, True),
    15: (2, -900.0, 19000.0, False),
    16: (2, 0.0, 180.0, False),
    17: (2, 0.0, 180.0, False),
    18: (4, 0.0, 360.0, False),
    19: (4, -180.0, 180.0, True),
    20: (4, 0.0, 360.0, False),
    21: (4, 0.0, 5e6, False),
    25: (2, -900.0, 19000.0, False),
    75: (2, -900.0, 19000.0, False),
    78: (2, -900.0, 19000.0, False),
}


def encode_value(tag: int, value: float) -> bytes:
    """Tag, length and value of a number."""
    if tag == 2:
        return bytes([2, 8]) + round(value * 1e6).to_bytes(8)
    size, low, high, signed = _TAGS[tag]
    if signed:
        number = round(value * (2 ** (8 * size - 1) - 1) / high)
    else:
        number = round((value - low) / (high - low) * (2 ** (8 * size) - 1))
    return bytes([tag, size]) + number.to_bytes(size, signed=signed)


def encode_set(tags: Mapping[int, float], extra: bytes = b"") -> bytes:
    """A local set with its checksum: the sum of its 16 bit words up to the checksum's own length."""
    value = b"".join(encode_value(tag, tags[tag]) for tag in sorted(tags)) + extra
    length = len(value) + 4
    return with_checksum(KEY + (bytes([length]) if length < 128 else bytes([0x81, length])) + value + b"\x01\x02")


def with_checksum(packet: bytes) -> bytes:
    """A set that lacks its last two bytes, with them."""
    words = sum(byte << (8 if at % 2 == 0 else 0) for at, byte in enumerate(packet))
    return packet + (words & 0xFFFF).to_bytes(2)


def encode_telemetry(telemetry: Telemetry, hfov_deg: float, ground_m: float = 37.0) -> list[bytes]:
    """The sets of a drone whose platform rolls and pitches below a camera that does what the telemetry says."""
    sets = []
    for k, time_s in enumerate(telemetry.time_s):
        platform = Rotation.from_euler("ZYX", (200.0 + k, 3.0 - 0.1 * k, -4.0 + 0.2 * k), degrees=True)
        pitch, roll = telemetry.pitch_deg[k], telemetry.roll_deg[k]
        camera = Rotation.from_euler("ZYX", (telemetry.yaw_deg[k], pitch, 0.0), degrees=True)
        camera = camera * Rotation.from_euler("Z", -roll, degrees=True)  # about the picture's own vertical axis
        heading, platform_pitch, platform_roll = platform.as_euler("ZYX", degrees=True)
        azimuth, elevation, sensor_roll = (platform.inv() * camera).as_euler("ZYX", degrees=True)
        tags = {2: telemetry.clock_s[k], 5: heading % 360, 6: platform_pitch, 7: platform_roll}
        tags |= {13: telemetry.latitude_deg[k], 14: telemetry.longitude_deg[k], 16: hfov_deg}
        tags |= {18: azimuth % 360, 19: elevation, 20: sensor_roll % 360}
        tags |= {15: telemetry.height_m[k] + ground_m, 25: ground_m}
        sets.append(encode_set({tag: float(value) for tag, value in tags.items()}))
        assert time_s == telemetry.time_s[k]
    return sets


def write_transport_stream(path: Path, packets: Sequence[bytes], fps: int = 25) -> Path:
    """An MPEG-TS with a frame and a packet of KLV each; it begins 1.4 s after 0, as libav's do."""
    with av.open(str(path), "w") as container:
        video, data = container.add_stream("libx264", rate=fps), container.add_data_stream("klv")
        video.width, video.height, video.pix_fmt = 160, 120, "yuv420p"
        for number, grey in enumerate(drifting(len(packets), width=160)):
            frame = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
            frame.time_base, frame.pts = Fraction(1, fps), number
            container.mux(video.encode(frame))
            packet = av.Packet(packets[number])
            packet.stream, packet.time_base, packet.pts, packet.dts = data, Fraction(1, fps), number, number
            container.mux(packet)
        container.mux(video.encode())
    return path
