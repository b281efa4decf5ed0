"""Images, arrays and messages. Caffe: python/caffe/test/test_io.py and what scripts do beyond it."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netspec.pycaffe as caffe
from netspec.compat.pycaffe.io import Transformer
from netspec.compat.pycaffe.proto import caffe_pb2

RANDOM = np.random.RandomState(1)


# ---- Messages ----


def blob_proto(values: np.ndarray, **shape: Any) -> Any:
    return caffe_pb2.BlobProto(data=values.ravel().tolist(), **shape)


def test_a_blob_of_the_old_format() -> None:
    proto = blob_proto(np.zeros(100), num=1, channels=1, height=10, width=10)
    assert caffe.io.blobproto_to_array(proto).shape == (1, 1, 10, 10)


def test_a_blob_of_the_new_format() -> None:
    assert caffe.io.blobproto_to_array(blob_proto(np.zeros(100), shape={"dim": [10, 10]})).shape == (10, 10)


def test_a_blob_without_a_shape() -> None:
    with pytest.raises(ValueError, match="reshape"):
        caffe.io.blobproto_to_array(blob_proto(np.zeros(100)))


def test_a_scalar_blob() -> None:
    assert caffe.io.blobproto_to_array(blob_proto(np.full(1, 123.0))) == 123


def test_data_and_diff_can_be_written_and_read() -> None:
    data, diff = RANDOM.rand(2, 3, 4).astype(np.float32), RANDOM.rand(2, 3, 4).astype(np.float32)
    proto = caffe.io.array_to_blobproto(data, diff)
    np.testing.assert_array_equal(caffe.io.blobproto_to_array(proto), data)
    np.testing.assert_array_equal(caffe.io.blobproto_to_array(proto, return_diff=True), diff)
    assert caffe.io.blobproto_to_array(proto).dtype == np.float64  # as Caffe has it


def test_scripts_can_read_a_mean_file(tmp_path: Path) -> None:
    mean = RANDOM.rand(1, 3, 5, 6).astype(np.float32)
    (tmp_path / "mean.binaryproto").write_bytes(caffe.io.array_to_blobproto(mean).SerializeToString())
    blob = caffe.io.caffe_pb2.BlobProto.FromString((tmp_path / "mean.binaryproto").read_bytes())
    np.testing.assert_array_equal(np.array(caffe.io.blobproto_to_array(blob))[0], mean[0])


def test_several_arrays_as_bytes() -> None:
    arrays = [RANDOM.rand(1, 2), RANDOM.rand(3)]
    for write in (caffe.io.arraylist_to_blobprotovector_str, caffe.io.arraylist_to_blobprotovecor_str):
        for array, read in zip(arrays, caffe.io.blobprotovector_str_to_arraylist(write(arrays)), strict=True):
            np.testing.assert_allclose(read, array, rtol=1e-6)


def test_a_label_that_is_not_given_is_not_in_the_datum() -> None:
    image = np.ones((10, 10, 3))
    with_label, without = caffe.io.array_to_datum(image, label=1), caffe.io.array_to_datum(image)
    assert len(with_label.SerializeToString()) > len(without.SerializeToString())
    assert not without.HasField("label")


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int64])
def test_a_datum_can_be_written_and_read(dtype: Any) -> None:
    array = (RANDOM.rand(3, 4, 5) * 255).astype(dtype)
    datum = caffe.io.array_to_datum(array, np.int64(7))
    assert (datum.channels, datum.height, datum.width, datum.label) == (3, 4, 5, 7)
    assert bool(datum.data) == (dtype == np.uint8)
    read = caffe.io.datum_to_array(datum)
    np.testing.assert_array_equal(read, array)
    read += 1  # it is the caller's


def test_a_datum_has_three_axes() -> None:
    with pytest.raises(ValueError, match=r"Incorrect array shape: found \(2, 2\)"):
        caffe.io.array_to_datum(np.zeros((2, 2)))


# ---- Transformer ----


@pytest.fixture
def transformer() -> Transformer:
    made = Transformer({"data": (1, 3, 6, 5)})
    made.set_transpose("data", (2, 0, 1))
    return made


def test_preprocessing_in_its_order(transformer: Transformer) -> None:
    image = RANDOM.rand(6, 5, 3).astype(np.float32)
    transformer.set_raw_scale("data", 255)
    transformer.set_channel_swap("data", (2, 1, 0))
    transformer.set_mean("data", np.array([104.0, 117.0, 123.0]))
    transformer.set_input_scale("data", 0.5)
    expected = (image[:, :, ::-1].transpose(2, 0, 1) * 255 - np.array([104, 117, 123])[:, None, None]) * 0.5
    got = transformer.preprocess("data", image)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(transformer.deprocess("data", got[np.newaxis]), image, rtol=1e-4, atol=1e-5)


def test_an_image_of_another_size_is_resized(transformer: Transformer) -> None:
    image = RANDOM.rand(12, 9, 3)
    expected = caffe.io.resize_image(image.astype(np.float32), (6, 5)).transpose(2, 0, 1)
    np.testing.assert_array_equal(transformer.preprocess("data", image), expected)


def test_deprocessing_of_a_swap_that_is_not_its_own_inverse(transformer: Transformer) -> None:
    image = RANDOM.rand(6, 5, 3)
    transformer.set_channel_swap("data", (1, 2, 0))
    np.testing.assert_allclose(transformer.deprocess("data", transformer.preprocess("data", image)), image, rtol=1e-6)


@pytest.mark.parametrize("shape", [(3,), (3, 6, 5)])
def test_means(transformer: Transformer, shape: tuple[int, ...]) -> None:
    mean = RANDOM.rand(*shape)
    transformer.set_mean("data", mean)
    got = transformer.preprocess("data", np.zeros((6, 5, 3)))
    np.testing.assert_allclose(got, np.broadcast_to(-mean.reshape(3, *(shape[1:] or (1, 1))), got.shape), rtol=1e-6)


def test_a_mean_image_of_another_size_is_resized_as_in_caffe(transformer: Transformer) -> None:
    mean = RANDOM.rand(3, 12, 9) * 255
    transformer.set_mean("data", mean)
    low, high = mean.min(), mean.max()
    unit = caffe.io.resize_image(((mean - low) / (high - low)).transpose(1, 2, 0), (6, 5)).transpose(2, 0, 1)
    np.testing.assert_array_equal(transformer.mean["data"], unit * (high - low) + low)
    transformer.set_mean("data", np.full((3, 2, 2), 7.0))  # Caffe would divide by zero
    np.testing.assert_array_equal(transformer.mean["data"], np.full((3, 6, 5), 7))


def test_names_that_caffe_imports_exist() -> None:
    from scipy.ndimage import zoom

    assert caffe.io.zoom is zoom
    assert caffe.io.resize.__name__ == "resize"


def test_a_mean_image_of_one_channel() -> None:
    gray = Transformer({"data": (1, 1, 6, 5)})
    gray.set_mean("data", np.ones((6, 5)))
    assert gray.mean["data"].shape == (6, 5)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((2,), "Mean channels incompatible with input: found 2, expected 3"),
        ((2, 6, 7), "Mean channels incompatible with input: found 2, expected 3"),
        ((1, 3, 6, 5), "Mean shape invalid"),
    ],
)
def test_means_of_other_shapes(transformer: Transformer, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transformer.set_mean("data", np.zeros(shape))


def test_settings_that_do_not_fit_the_input_are_refused(transformer: Transformer) -> None:
    with pytest.raises(Exception, match="Transpose order needs to have the same number of dimensions as the input"):
        transformer.set_transpose("data", (1, 0))
    with pytest.raises(Exception, match="Channel swap needs to have the same number of dimensions as the input chan"):
        transformer.set_channel_swap("data", (1, 0))
    calls: list[Any] = [transformer.set_raw_scale, transformer.set_mean, transformer.preprocess, transformer.deprocess]
    for call in calls:
        with pytest.raises(Exception, match=r"image is not one of the net inputs: \['data'\]"):
            call("image", 1)  # pyright: ignore[reportArgumentType]  # refused for its name


# ---- Images ----


@pytest.mark.slow
def test_images_are_loaded_as_scikit_image_does(tmp_path: Path) -> None:
    skimage_io = pytest.importorskip("skimage.io")
    from skimage import img_as_float

    pixels = (RANDOM.rand(7, 9, 4) * 255).astype(np.uint8)
    for name, stored in (("rgba.png", pixels), ("rgb.png", pixels[..., :3]), ("gray.png", pixels[..., 0])):
        skimage_io.imsave(tmp_path / name, stored, check_contrast=False)
    color = caffe.io.load_image(str(tmp_path / "rgb.png"))
    assert color.dtype == np.float32
    np.testing.assert_array_equal(color, img_as_float(pixels[..., :3]).astype(np.float32))
    np.testing.assert_array_equal(caffe.io.load_image(str(tmp_path / "rgba.png")), color)
    gray = caffe.io.load_image(str(tmp_path / "gray.png"))
    assert gray.shape == (7, 9, 3)
    np.testing.assert_array_equal(gray[..., :1], caffe.io.load_image(str(tmp_path / "gray.png"), color=False))
    assert caffe.io.load_image(str(tmp_path / "rgb.png"), False).shape == (7, 9, 1)


@pytest.mark.parametrize("kind", [np.uint8, np.float32, np.float64])
@pytest.mark.parametrize("size", [(4, 5), (20, 30), (9, 11), (1, 40), (27, 3)])
@pytest.mark.parametrize("channels", [1, 3])
def test_images_are_resized_to_the_bits_of_scikit_image(size: tuple[int, int], channels: int, kind: Any) -> None:
    transform = pytest.importorskip("skimage.transform")
    for order in (1, 3):
        image = (RANDOM.rand(9, 11, channels) * 255).astype(kind)
        low, span = image.min(), image.max() - image.min()
        unit = transform.resize((image - low) / span, size, order=order, mode="constant", anti_aliasing=False)
        got = caffe.io.resize_image(image, size, order)
        np.testing.assert_array_equal(got, (unit * span + low).astype(np.float32), strict=True)


def test_a_constant_image_and_one_of_other_channels() -> None:
    np.testing.assert_array_equal(caffe.io.resize_image(np.full((4, 4, 3), 7.0), (2, 3)), np.full((2, 3, 3), 7))
    stack = RANDOM.rand(4, 4, 5)
    got = caffe.io.resize_image(stack, (8, 6))
    assert got.shape == (8, 6, 5)
    np.testing.assert_allclose(got[0, 0], stack[0, 0], rtol=1e-6)


def test_without_scikit_image_one_line_gives_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("skimage", "skimage.io", "skimage.transform"):
        monkeypatch.setitem(sys.modules, name, None)
    for call in (lambda: caffe.io.load_image("x.png"), lambda: caffe.io.resize_image(np.eye(3)[..., None], (2, 2), 3)):
        with pytest.raises(ImportError, match=r"^caffe\.io\.\w+ needs scikit-image: pip install scikit-image, or "):
            call()


def test_names_that_scripts_import_from_caffes_io_exist() -> None:
    skimage = pytest.importorskip("skimage")
    from skimage.transform import resize

    assert caffe.io.skimage is skimage
    assert caffe.io.resize is resize
    assert not hasattr(caffe.io, "flip_image")  # a fork's


@pytest.mark.parametrize(("extent", "crop"), [((8, 10), (4, 6)), ((7, 7), (4, 4))])
def test_oversampling(extent: tuple[int, int], crop: tuple[int, int]) -> None:
    images = [RANDOM.rand(*extent, 3).astype(np.float32) for _ in range(2)]
    crops = caffe.io.oversample(images, crop)
    assert crops.shape == (20, *crop, 3)
    (height, width), (h, w) = extent, crop
    second = crops[10:15]
    np.testing.assert_array_equal(second[0], images[1][:h, :w])
    np.testing.assert_array_equal(second[1], images[1][:h, width - w :])
    np.testing.assert_array_equal(second[2], images[1][height - h :, :w])
    np.testing.assert_array_equal(second[3], images[1][height - h :, width - w :])
    top, left = (height - h) // 2, (width - w) // 2
    np.testing.assert_array_equal(second[4], images[1][top : top + h, left : left + w])
    np.testing.assert_array_equal(crops[15:], second[:, :, ::-1])
