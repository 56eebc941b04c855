import os

import numpy as np
import pytest
from helpers.readers.pictures import Image, count_gif, read_mp4

from carlasc.errors import ArgumentError, CarlascError, StorageError
from carlasc.viewing.rendering.encoding import encodable_size, is_film, write_pictures


def flat_pictures(count, size=(64, 48)):
    """Pictures of one grey each, brighter and brighter."""
    for i in range(count):
        yield np.full((size[1], size[0], 3), 20 + 10 * i, np.uint8)


def test_a_png_holds_the_picture_exactly(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    write_pictures(tmp_path / "a.png", [picture], 10)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), picture)


def test_an_mp4_has_every_picture_in_order_at_its_rate(tmp_path):
    write_pictures(tmp_path / "a.mp4", flat_pictures(17), 12.5)
    meta, frames = read_mp4(tmp_path / "a.mp4")
    assert len(frames) == 17
    assert (meta["size"], meta["fps"]) == ((64, 48), 12.5)
    assert (meta["codec"], meta["pix_fmt"].split("(")[0]) == ("h264", "yuv420p")
    np.testing.assert_allclose([frame.mean() for frame in frames], 20 + 10 * np.arange(17), atol=3)


def test_a_gif_has_every_picture_at_its_rate_and_runs_on(tmp_path):
    write_pictures(tmp_path / "a.gif", flat_pictures(7), 10)
    assert count_gif(tmp_path / "a.gif") == 7
    film = Image.open(tmp_path / "a.gif")
    assert (film.info["duration"], film.info["loop"]) == (100, 0)
    for i in range(7):
        film.seek(i)
        assert abs(int(np.asarray(film.convert("RGB")).mean()) - (20 + 10 * i)) <= 1


@pytest.mark.parametrize("size", [(64, 48), (65, 49)])
def test_a_webp_has_every_picture_at_its_rate_and_runs_on(tmp_path, size):
    write_pictures(tmp_path / "a.webp", flat_pictures(7, size), 12.5)
    film = Image.open(tmp_path / "a.webp")
    assert (film.size, film.n_frames, film.info["loop"]) == (size, 7, 0)
    for i in range(7):
        film.seek(i)
        assert abs(np.asarray(film.convert("RGB")).mean() - (20 + 10 * i)) <= 3
        assert film.info["duration"] == 80


def test_a_png_says_its_resolution_where_one_is_given(tmp_path):
    for name, dpi in (("a.png", 300), ("b.png", None)):
        write_pictures(tmp_path / name, flat_pictures(1), 10, dpi)
    assert Image.open(tmp_path / "a.png").info["dpi"] == pytest.approx((300, 300), abs=0.01)
    assert "dpi" not in Image.open(tmp_path / "b.png").info


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.mp4", "a.webp"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, CarlascError])
def test_interrupted_pictures_leave_no_file(tmp_path, monkeypatch, name, error):
    # of its own: other tests use that of the system at the same time
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))

    def broken():
        if name != "a.png":
            yield from flat_pictures(3)
        raise error("stop")

    with pytest.raises(error):
        write_pictures(tmp_path / name, broken(), 10)
    assert os.listdir(tmp_path) == ["temporary"]
    assert os.listdir(temporary) == []


def test_an_existing_film_stays_until_the_new_one_is_complete(tmp_path):
    target = tmp_path / "a.mp4"
    write_pictures(target, flat_pictures(3), 10)
    old = target.read_bytes()

    def broken():
        yield from flat_pictures(2)
        assert target.read_bytes() == old
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_pictures(target, broken(), 10)
    assert target.read_bytes() == old


def test_the_message_of_a_failing_encoder_is_reported(tmp_path):
    def odd():  # yuv420p has no odd sizes: the encoder refuses
        yield from flat_pictures(2, (63, 47))

    with pytest.raises(CarlascError, match=r"exit code .*divisible by 2|exit code"):
        write_pictures(tmp_path / "a.mp4", odd(), 10)
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_made_is_named_before_anything_is_drawn(tmp_path):
    (tmp_path / "file").write_text("x")

    def never():
        raise AssertionError("drawn for nothing")
        yield

    with pytest.raises(StorageError, match="file"):
        write_pictures(tmp_path / "file" / "a.mp4", never(), 10)


def test_endings_tell_the_format(tmp_path):
    assert not is_film(tmp_path / "a.PNG")
    assert is_film(tmp_path / "a.Mp4")
    assert encodable_size(tmp_path / "a.mp4", (321, 200)) == (322, 200)
    assert encodable_size(tmp_path / "a.gif", (321, 201)) == (321, 201)


@pytest.mark.parametrize("fps", [0, -1, 1000, float("nan")])
def test_an_impossible_rate_is_refused(tmp_path, fps):
    with pytest.raises(ArgumentError, match="fps"):
        write_pictures(tmp_path / "a.gif", flat_pictures(2), fps)
