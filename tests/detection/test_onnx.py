"""Another maker's network in the place of our detector: a tiny YOLO, made here, of every layout."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from schemas.detector import OnnxLayout
from schemas.job import Job
from velfield import open_run
from velfield.detection.interface import Detector
from velfield.detection.onnx.boxes import Boxes, suppress
from velfield.detection.onnx.description import describe_model
from velfield.detection.onnx.detector import OnnxDetector
from velfield.detection.registry import load_detector
from velfield.errors import InputError
from velfield.pipeline.georeference import plan_of_finished
from velfield.pipeline.plan import Plan
from velfield.pipeline.stages.detections import detect_block
from velfield.pipeline.stages.detector import make_detector
from velfield.pipeline.stages.tracklets import explain_no_tracklets

TILE = 128
LENGTH, WIDTH, ANGLE = 16.0, 8.0, 0.5
NAMES = ("tree", "car", "bus")
LAYOUTS: tuple[OnnxLayout, ...] = (
    "boxes",
    "oriented_boxes",
    "boxes_with_objectness",
    "end_to_end",
    "end_to_end_oriented",
)


def tiny_yolo(path: Path, layout: OnnxLayout, *, metadata: bool = True, names: tuple[str, ...] = NAMES) -> Path:
    """A network that takes each bright cell of 8 x 8 px for a car of 16 x 8 px about it."""
    side = TILE // 8
    y, x = np.mgrid[:side, :side].reshape(2, -1) * 8 + 4.0
    n, rows = len(x), layout.startswith(("end", "boxes_with"))
    box = np.stack([x, y, np.full(n, LENGTH), np.full(n, WIDTH)])
    if layout == "end_to_end":
        box = np.stack([x - LENGTH / 2, y - WIDTH / 2, x + LENGTH / 2, y + WIDTH / 2])
    low, one, angle = np.full((1, n), 0.05), np.ones((1, n)), np.full((1, n), ANGLE)
    after = {
        "boxes": [box, low, "score", low],
        "oriented_boxes": [box, low, "score", low, angle],
        "boxes_with_objectness": [box, one, low, "score", low],
        "end_to_end": [box, "score", one],
        "end_to_end_oriented": [box, "score", one, angle],
    }[layout]
    constants = {f"c{k}": part[None].astype(np.float32) for k, part in enumerate(after) if not isinstance(part, str)}
    parts = [part if isinstance(part, str) else f"c{k}" for k, part in enumerate(after)]
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("ReduceMean", ["pooled"], ["grey"], axes=[1], keepdims=1),
        helper.make_node("Reshape", ["grey", "shape"], ["score"]),
        helper.make_node("Concat", parts, ["columns"], axis=1),
        helper.make_node("Transpose" if rows else "Identity", ["columns"], ["output0"]),
    ]
    if rows:
        nodes[-1].attribute.append(helper.make_attribute("perm", [0, 2, 1]))
    weights = [numpy_helper.from_array(np.array([1, 1, n]), "shape")]
    weights += [numpy_helper.from_array(value, name) for name, value in constants.items()]
    channels = sum(1 if isinstance(part, str) else len(part) for part in after)
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, TILE, TILE])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, n, channels] if rows else [1, channels, n])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if metadata:
        helper.set_model_props(
            model,
            {
                "task": "obb" if "oriented" in layout else "detect",
                "names": str(dict(enumerate(names))),
                "imgsz": f"[{TILE}, {TILE}]",
            },
        )
    onnx.save(model, str(path))
    return path


@pytest.fixture
def image() -> tuple[np.ndarray, np.ndarray]:
    """An image larger than a tile, with bright cells, and their centres in our pixels."""
    grey = np.full((224, 320), 20, np.uint8)  # tiles begin at 0, 96, 192 and 0, 96: on the cells' grid
    corners = np.array([[8, 16], [120, 40], [112, 104], [232, 160], [304, 80]])  # the second is cut by a tile's edge
    for x, y in corners:
        grey[y : y + 8, x : x + 8] = 240
    return grey, corners + 3.5


def sorted_rows(xy: Any) -> list[list[float]]:
    return sorted(np.round(np.asarray(xy, float), 3).tolist())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_boxes_of_every_layout_are_found_across_tiles(
    layout: OnnxLayout, image: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    detector = load_detector(tiny_yolo(tmp_path / "m.onnx", layout))
    assert detector.record.method == "onnx"
    assert detector.record.layout == layout
    assert detector.record.vehicles == (1, 2)
    table = detector.detect_raw(image[0], threshold=0.9)
    assert sorted_rows(table[["x_px", "y_px"]]) == sorted_rows(image[1])
    if "oriented" in layout:
        assert table["orientation_rad"].tolist() == pytest.approx([ANGLE] * len(table), abs=1e-5)
        assert table["length_px"].tolist() == pytest.approx([LENGTH] * len(table))
    else:
        assert table["abs_box_angle_rad"].tolist() == pytest.approx([np.arctan2(WIDTH, LENGTH)] * len(table))
    assert detector.detect_raw(image[0], threshold=0.96).empty
    assert len(detector.detect(image[0], threshold=0.9)) == len(image[1])


def test_a_model_without_metadata_is_described_by_a_yaml(image: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    path = tiny_yolo(tmp_path / "m.onnx", "boxes", metadata=False)
    with pytest.raises(InputError, match="found no metadata"):
        load_detector(path)
    (tmp_path / "m.yaml").write_text("layout: boxes\nclasses: [tree, thing, other]\nvehicles: [1]\nthreshold: 0.9\n")
    detector = load_detector(path)
    assert len(detector.detect_raw(image[0])) == len(image[1])
    (tmp_path / "m.yaml").write_text("layout: squares\nclases: [car]\nvehicles: [car]\nthreshold: 2\n")
    with pytest.raises(InputError, match=r"m\.yaml: layout: .*; vehicles\.0: .*; threshold: .*; clases: .*expected"):
        load_detector(path)


def test_the_yaml_of_the_documentation_describes_a_model(image: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "detection.md").read_text()
    text = re.search(r"^# model\.yaml\n.*?(?=^```)", page, re.MULTILINE | re.DOTALL)
    path = tiny_yolo(tmp_path / "model.onnx", "boxes", metadata=False)
    path.with_suffix(".yaml").write_text(text[0])
    detector = load_detector(path)
    assert [detector.record.classes[k] for k in detector.record.vehicles] == ["car", "bus"]
    assert len(detector.detect_raw(image[0], threshold=0.9)) == len(image[1])


@pytest.mark.parametrize(("dtype", "highest"), [("float32", 1.0), ("float16", 1.0), ("uint8", 255.0)])
def test_a_model_gets_the_input_range_of_the_documentation(dtype: str, highest: float, tmp_path: Path) -> None:
    """A model whose output is its input: white is 1 of floats, 255 of bytes; all three channels are equal."""
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    graph = helper.make_graph(
        [helper.make_node("Reshape", ["images", "shape"], ["output0"])],
        "same",
        [helper.make_tensor_value_info("images", kind, [1, 3, TILE, TILE])],
        [helper.make_tensor_value_info("output0", kind, [1, TILE * TILE // 2, 6])],
        [numpy_helper.from_array(np.array([1, -1, 6]), "shape")],
    )
    path = tmp_path / "same.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), str(path))
    path.with_suffix(".yaml").write_text("layout: end_to_end\nclasses: [car]\nvehicles: [0]\n")
    detector = load_detector(path)
    assert isinstance(detector, OnnxDetector)
    grey = np.zeros((TILE, TILE), np.uint8)
    grey[:, 5:] = 255
    seen = detector._run(grey).reshape(3, TILE, TILE)
    assert (seen.dtype, seen.min(), seen.max()) == (np.dtype(dtype), 0.0, highest)
    assert (seen == seen[0]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("layout: end_to_end\nclasses: [tree, car, bus]\nvehicles: [1]\n", r"\(1, n, 6\) of the layout end_to_end;"),
        (
            "layout: oriented_boxes\nclasses: [tree, car, bus]\nvehicles: [1]\n",
            r"\(1, 5 \+ 3 classes, n\) of the layout",
        ),
        (
            "layout: boxes\nclasses: [tree, car]\nvehicles: [1]\n",
            r"found an output of \(1, 7, 256\), expected \(1, 4 \+ 2 ",
        ),
        ("layout: boxes\nvehicles: [3]\n", r"expected \(1, 8 or more, n\)"),
        (
            "layout: boxes\nclasses: [tree, car, bus]\nvehicles: [1, 3]\n",
            r"m\.yaml: found vehicles: 3, .* 0 to 2 \(tree, car",
        ),
        ("layout: boxes\nvehicles: [-1]\n", "found vehicles: -1, expected numbers from 0 on"),
        ("layout: boxes\nclasses: [tree, car, bus]\nvehicles: []\n", "found vehicles: none, expected numbers"),
        ("layout: boxes\nclasses: [tree, car, bus]\nvehicles: [car]\n", r"found 'car', expected the number of a class"),
        ("layuot: boxes\n", "layuot: no such key, did you mean 'layout'"),
        ("layout: boxes\nclasses: [tree, car\nvehicles: [1]\n", "not YAML at line 3, expected"),
    ],
)
def test_a_description_that_does_not_fit_its_model_is_refused(text: str, message: str, tmp_path: Path) -> None:
    """The columns of another layout would be read without an error."""
    path = tiny_yolo(tmp_path / "m.onnx", "boxes", metadata=False)
    path.with_suffix(".yaml").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        load_detector(path)
    assert "\n" not in str(error.value)


def with_open_output(model: onnx.ModelProto) -> None:
    for k in (1, 2):
        model.graph.output[0].type.tensor_type.shape.dim[k].dim_param = f"size{k}"
    model.metadata_props.clear()


def with_fractions(model: onnx.ModelProto) -> None:
    box = next(one for one in model.graph.initializer if one.name == "c0")
    box.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(box) / np.float32(TILE), "c0"))


def test_an_output_that_shows_only_at_an_image_is_refused(image: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    path = changed(tmp_path / "m.onnx", with_open_output)
    path.with_suffix(".yaml").write_text("layout: boxes\nclasses: [tree, car]\nvehicles: [1]\n")
    detector = load_detector(path)
    with pytest.raises(InputError, match=r"found an output of \(1, 7, 256\), expected \(1, 4 \+ 2 classes, n\)"):
        detector.detect_raw(image[0])


def test_boxes_in_fractions_of_the_input_are_refused(image: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    detector = load_detector(changed(tmp_path / "m.onnx", with_fractions))
    assert detector.detect_raw(np.zeros_like(image[0]), threshold=0.5).empty
    with pytest.raises(InputError, match="like fractions of its sides, expected pixels; multiply"):
        detector.detect_raw(image[0], threshold=0.5)


def with_unused_weight(model: onnx.ModelProto) -> None:
    model.graph.initializer.append(numpy_helper.from_array(np.zeros(1, np.float32), "nobody's"))


def test_onnxruntime_prints_nothing_of_how_a_graph_was_exported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    load_detector(changed(tmp_path / "m.onnx", with_unused_weight))
    assert capfd.readouterr().err == ""


def test_models_in_other_formats_and_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "best.pt").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"found a model as \.pt, expected \.onnx .*; export it as ONNX"):
        load_detector(tmp_path / "best.pt")
    with pytest.raises(InputError, match="found a folder, expected a file"):
        load_detector(tmp_path)


def test_models_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected one that is a vehicle"):
        load_detector(tiny_yolo(tmp_path / "m.onnx", "boxes", names=("tree", "bird", "cat")))
    (tmp_path / "n.onnx").write_bytes(b"no model")
    with pytest.raises(InputError, match="no ONNX model"):
        load_detector(tmp_path / "n.onnx")
    detector = load_detector(tiny_yolo(tmp_path / "o.onnx", "boxes"))
    again = type(detector)(detector.record)
    tiny_yolo(tmp_path / "o.onnx", "oriented_boxes")
    with pytest.raises(InputError, match="the model has changed"):
        again.detect_raw(np.zeros((64, 64), np.uint8))
    with pytest.raises(InputError, match="expected a detector of velfield"):
        OnnxDetector.train([], None)


def changed(path: Path, change: Callable[[onnx.ModelProto], object]) -> Path:
    """A tiny model with something wrong in it."""
    model = onnx.load(str(tiny_yolo(path, "boxes")))
    change(model)
    path.write_bytes(model.SerializeToString())
    return path


def with_external_data(model: onnx.ModelProto) -> None:
    weight = next(one for one in model.graph.initializer if one.name == "c0")
    weight.data_location = onnx.TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="secrets.bin")
    weight.ClearField("raw_data")


def with_two_inputs(model: onnx.ModelProto) -> None:
    model.graph.input.append(helper.make_tensor_value_info("more", TensorProto.FLOAT, [1]))
    model.graph.node.append(helper.make_node("Identity", ["more"], ["unused"]))


def with_side(side: int) -> Callable[[onnx.ModelProto], None]:
    def change(model: onnx.ModelProto) -> None:
        for k in (2, 3):
            model.graph.input[0].type.tensor_type.shape.dim[k].dim_value = side

    return change


def with_channels_last(model: onnx.ModelProto) -> None:
    for k, size in enumerate((1, TILE, TILE, 3)):
        model.graph.input[0].type.tensor_type.shape.dim[k].dim_value = size


def with_open_side(model: onnx.ModelProto) -> None:
    for k in (2, 3):
        model.graph.input[0].type.tensor_type.shape.dim[k].dim_param = "side"
    next(one for one in model.metadata_props if one.key == "imgsz").value = "[900000, 900000]"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_external_data, "found weights in other files .*secrets.bin"),
        (with_two_inputs, "found 2 inputs, expected one"),
        (with_channels_last, r"found an input of \(1, 128, 128, 3\), .*; export it with channels first"),
        (with_side(8), "found an input of 8 x 8 px, expected 32 to 8192"),
        (with_side(200_000), "found an input of 200000 x 200000 px"),
        (with_open_side, "found an input of 900000 x 900000 px"),
    ],
)
def test_a_model_reads_no_other_file_and_takes_one_image_of_a_sound_size(
    change: Callable[[onnx.ModelProto], object], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # onnxruntime looks for external data here
    (tmp_path / "secrets.bin").write_bytes(bytes(1 << 20))
    with pytest.raises(InputError, match=message):
        load_detector(changed(tmp_path / "m.onnx", change))


def test_a_model_that_fails_on_an_image_is_one_line(tmp_path: Path) -> None:
    detector = load_detector(changed(tmp_path / "m.onnx", with_side(2 * TILE)))  # its boxes are for half of that
    with pytest.raises(InputError, match=r"m\.onnx: onnxruntime cannot run this model on a tile of") as error:
        detector.detect_raw(np.zeros((TILE, TILE), np.uint8))
    assert "\n" not in str(error.value)


def test_of_two_boxes_of_one_vehicle_the_better_is_kept() -> None:
    size = np.array([[16.0, 8.0]] * 3)
    xy = np.array([[20.0, 20.0], [21.0, 20.0], [60.0, 20.0]])
    for angle in (0.0, 0.7):
        kept = suppress(Boxes(xy, size, np.full(3, angle), np.array([0.5, 0.9, 0.4])), 0.1)
        assert kept.score.tolist() == [0.9, 0.4]


def plan_with(detector: Path, root: Path, threshold: float) -> Plan:
    """The plan of a finished run with another detector."""
    made = plan_of_finished(open_run(root))
    inputs = made.job.inputs.model_copy(update={"labels": None, "detector": str(detector)})
    config = made.config.model_copy(
        update={"detection": made.config.detection.model_copy(update={"threshold": threshold})}
    )
    return Plan(Job(root=str(root), inputs=inputs, config=config), made.info, made.indices, made.inputs, made.keys)


def test_a_run_detects_with_it_on_raw_frames(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tiny_yolo(tmp_path / "m.onnx", "oriented_boxes")
    plan = plan_with(path, copy, 0.75)
    monkeypatch.setattr("velfield.detection.onnx.detector.device_limitations", lambda device: [f"no GPU: {device}"])
    outcome = make_detector(plan)
    assert outcome.counts["threshold"] == 0.25
    assert outcome.warnings.count("no GPU: auto") == 1
    run, frame = open_run(copy), 3
    block = detect_block(plan, range(frame, frame + 1))
    detector: Detector = load_detector(path)
    raw = detector.detect_raw(run.frames.read(frame), threshold=0.75)
    assert len(raw) > 3
    expected = run.to_base(frame, raw[["x_px", "y_px"]].to_numpy())
    found = np.column_stack([block.cars.column["x_px"], block.cars.column["y_px"]])
    assert sorted_rows(found.round(1)) == sorted_rows(expected[np.isfinite(expected[:, 0])].round(1))
    assert block.searched.tolist() == [1.0]
    assert set(block.cars.crops) == {"chips", "strips", "xy_work", "sizes"}
    assert set(block.weak.crops) == {"chips", "strips", "xy_work", "sizes"}, "what is written of weak candidates"


def test_a_model_that_finds_nothing_is_told_what_to_check(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_yolo(tmp_path / "m.onnx", "oriented_boxes")
    plan = plan_with(path, whole, 0.99999)
    monkeypatch.setattr("velfield.pipeline.stages.detector._scale_of_gsd", lambda _: None)
    with pytest.raises(InputError, match=r"^the detector found no vehicle in \d+ frames, expected some, as the scale "):
        make_detector(plan)
    assert explain_no_tracklets(plan).endswith(
        "and if not check the model's classes, threshold and input values (documentation: Another detector)"
    )


def declared(path: Path, output: tuple[int | None, ...], **metadata: str) -> Path:
    """A model that only declares what it takes and gives."""
    graph = helper.make_graph(
        [helper.make_node("Identity", ["images"], ["output0"])],
        "declared",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, TILE, TILE])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, output)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {"task": "detect", **metadata})
    onnx.save(model, str(path))
    return path


TWELVE = [f"thing{k}" for k in range(12)]
TWELVE[2], TWELVE[5] = "car", "bus"
NAME_DIALECTS = {
    "Python's dictionary": {"names": str(dict(enumerate(TWELVE)))},
    "text keys": {"names": json.dumps({str(k): name for k, name in enumerate(TWELVE)})},
    "text keys of Python": {"names": str({str(k): name for k, name in sorted(enumerate(TWELVE), key=str)})},
    "a list": {"names": str(TWELVE)},
    "a list as JSON": {"classes": json.dumps(TWELVE)},
    "from names to numbers": {"names": json.dumps({name: k for k, name in enumerate(TWELVE)})},
    "a name a line": {"labels": "\n".join(TWELVE)},
    "commas": {"class_names": ", ".join(TWELVE)},
}


@pytest.mark.parametrize("dialect", NAME_DIALECTS)
def test_names_of_classes_are_in_order_of_their_numbers(dialect: str, tmp_path: Path) -> None:
    record = describe_model(declared(tmp_path / "m.onnx", (1, 16, 8400), **NAME_DIALECTS[dialect]))
    assert record.classes == tuple(TWELVE)
    assert record.vehicles == (2, 5)


@pytest.mark.parametrize("text", ["", "{}", "{'a': 'b'}", "{-1: 'car'}", "[[", "{99999: 'car'}"])
def test_names_that_say_nothing_are_asked_for(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="YAML file of the same name next to it"):
        describe_model(declared(tmp_path / "m.onnx", (1, 16, 8400), names=text))


ONE, TWO = str(["car"]), str(["car", "bus"])
SIX_COLUMNS = {
    "YOLOv5 of one class": ((1, 25200, 6), ONE, "boxes_with_objectness"),
    "suppressed in the graph": ((1, 300, 6), ONE, "end_to_end"),
    "suppressed, two classes": ((1, 300, 6), TWO, "end_to_end"),
    "transposed, two classes": ((1, 8400, 6), TWO, None),
    "open number of boxes": ((1, None, 6), ONE, None),
    "many classes": ((1, 25200, 6), str(TWELVE), "end_to_end"),
    "YOLOv8": ((1, 6, 8400), TWO, "boxes"),
    "a list of boxes of all images": ((None, 7), TWO, None),
}


@pytest.mark.parametrize("case", SIX_COLUMNS)
def test_six_columns_are_read_only_where_they_can_be_one_layout(case: str, tmp_path: Path) -> None:
    sizes, names, layout = SIX_COLUMNS[case]
    path = declared(tmp_path / "m.onnx", sizes, names=names)
    if layout is not None:
        assert describe_model(path).layout == layout
        return
    with pytest.raises(InputError, match="YAML file of the same name next to it"):
        describe_model(path)
    if sizes[1] is None:
        assert describe_model(declared(path, sizes, names=names, end2end="True")).layout == "end_to_end"
