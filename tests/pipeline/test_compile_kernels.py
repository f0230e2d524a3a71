"""The kernels of linking and detection are compiled without a flight."""

from typing import Any

from velfield.detection import boxes, changes, crops, nms
from velfield.detection.cnn import inference, model
from velfield.pipeline import compile_kernels
from velfield.tracking import appearance, crop_alignment


def test_crops_and_pictures_call_every_kernel_of_linking_and_detection() -> None:
    compile_kernels._link_crops()
    compile_kernels._search_pictures()
    called: tuple[Any, ...] = (
        crop_alignment._align_all,
        appearance._crop_differences,
        boxes._split_kernel,
        changes.difference_kernel,
        changes.changed_kernel,
        crops._chips_kernel,
        inference._cut_kernel,
        inference._place_kernel,
        model._peaks_kernel,
        nms._survivors,
    )
    assert [kernel.__name__ for kernel in called if not kernel.signatures] == []
