"""`carlasc.download` against a server that behaves, and against one that does not."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.errors import raises
from helpers.servers.http_server import Site, serve

from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError, MissingDataError
from carlasc.storage import download, downloading, extraction
from carlasc.storage.transport import fetching
from carlasc.storage.transport.fetching import FileFetch

VAL = "/val_cartesian.zip"
MEMBERS = {f"Val/Town07_Light/cartesian/velodyne/{i:06d}.bin": 9_000 + 16 * i for i in range(20)}


def make_zip(seed: int, members: dict[str, int] | None = None) -> bytes:
    """A stored zip of random bytes, about 180 kB."""
    rng, buffer = np.random.default_rng(seed), io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, size in (members or MEMBERS).items():
            archive.writestr(name, rng.bytes(size))
    return buffer.getvalue()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small blocks, and short waits between two attempts."""
    monkeypatch.setattr(fetching, "_BLOCK", 20_000)
    monkeypatch.setenv("CARLASC_REMOTE_BACKOFF_S", "0.001")


@pytest.fixture
def site() -> Iterator[Site]:
    with serve(Site({VAL: make_zip(0)})) as running:
        yield running


def get(site: Site, folder: Path, **options: object) -> Path:
    download(folder, split="val", base_url=site.url, **{"connections": 3, **options})  # type: ignore[arg-type]
    return folder / VAL[1:]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_zip_is_fetched_byte_for_byte_in_blocks_and_nothing_else_is_left(
    site: Site, tmp_path: Path
) -> None:
    assert get(site, tmp_path).read_bytes() == site.files[VAL]
    assert names(tmp_path) == ["val_cartesian.zip"]
    assert len(site.requests) > 5


def test_progress_ends_at_the_size_and_never_passes_it(site: Site, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    get(site, tmp_path, progress=lambda done, total: seen.append((done, total)))
    size = len(site.files[VAL])
    assert seen[-1] == (size, size)
    assert all(0 <= done <= total == size for done, total in seen)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_a_server_that_drops_every_connection_is_asked_again(site: Site, tmp_path: Path) -> None:
    site.drop_after = 7_001
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_tries_count_anew_after_each_byte_of_progress(site: Site, tmp_path: Path) -> None:
    site.drop_after = (
        2_500  # eight connections per block, where seven without progress are the last
    )
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_an_interrupted_download_continues_with_the_bytes_that_it_has(
    site: Site, tmp_path: Path
) -> None:
    def stop_at_a_third(done: int, total: int) -> None:
        if done > total / 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(site, tmp_path, progress=stop_at_a_third)
    assert names(tmp_path) == ["val_cartesian.zip.part", "val_cartesian.zip.part.json"]
    before = site.sent
    result = download(tmp_path, split="val", base_url=site.url, connections=3)
    size = len(site.files[VAL])
    assert (tmp_path / VAL[1:]).read_bytes() == site.files[VAL]
    assert result.archives[0].fetched < size * 0.75
    assert site.sent - before == result.archives[0].fetched + 2  # the two bytes of the first look
    assert names(tmp_path) == ["val_cartesian.zip"]


def test_a_server_that_dies_leaves_no_file_that_looks_complete_and_the_next_run_finishes(
    site: Site, tmp_path: Path
) -> None:
    content = site.files[VAL]

    def die(number: int) -> None:
        if number > 4:
            site.files.clear()

    site.before = die
    with pytest.raises(MissingDataError, match="404"):
        get(site, tmp_path)
    assert names(tmp_path) == ["val_cartesian.zip.part", "val_cartesian.zip.part.json"]
    site.before, site.files[VAL] = None, content
    assert get(site, tmp_path).read_bytes() == content


def test_a_file_that_changed_between_two_runs_is_not_mixed(site: Site, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(site, tmp_path, progress=stop)
    site.files[VAL] = make_zip(1)  # another content of the same size
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


@pytest.mark.parametrize("size_too", [False, True])
def test_a_file_that_changes_during_the_download_is_fetched_again(
    site: Site, tmp_path: Path, size_too: bool
) -> None:
    changed = make_zip(2, {**MEMBERS, "Val/more": 3_000} if size_too else None)

    def change(number: int) -> None:
        if number == 5:
            site.files[VAL] = changed

    site.before = change
    assert get(site, tmp_path).read_bytes() == changed


def test_a_file_that_keeps_changing_is_given_up_with_one_line(site: Site, tmp_path: Path) -> None:
    def change(number: int) -> None:
        site.files[VAL] = make_zip(number)

    site.before = change
    with pytest.raises(FormatError, match="a changed file in each of 3 attempts"):
        get(site, tmp_path, connections=1)
    assert "val_cartesian.zip" not in names(tmp_path)


def test_a_server_without_ranges_is_read_as_a_stream(site: Site, tmp_path: Path) -> None:
    site.ranges = False
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_a_server_that_promises_ranges_and_ignores_them_is_read_as_a_stream(
    site: Site, tmp_path: Path
) -> None:
    site.ignore_ranges_after = 3
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_a_stream_that_always_breaks_is_given_up_and_leaves_no_complete_file(
    site: Site, tmp_path: Path
) -> None:
    site.ranges, site.drop_after = False, 50_000
    with raises(CarlascError, problem="failed at each attempt", advice="again"):
        get(site, tmp_path)
    assert "val_cartesian.zip" not in names(tmp_path)


def test_a_stream_without_a_length_that_breaks_is_found_by_looking_into_the_zip(
    site: Site, tmp_path: Path
) -> None:
    site.ranges = site.lengths = False
    site.drop_after = 50_000
    with pytest.raises(FormatError, match="whole zip"):
        get(site, tmp_path)
    assert "val_cartesian.zip" not in names(tmp_path)


def test_a_stream_of_more_bytes_than_the_published_zip_can_have_is_ended(
    site: Site, tmp_path: Path
) -> None:
    site.ranges = site.lengths = False
    fetch = FileFetch(f"{site.url}{VAL}", tmp_path / "x.zip", 3)
    assert fetch.file.size is None
    with raises(
        FormatError, where="val_cartesian.zip", expected="at most 1000 bytes", found="more"
    ):
        fetch.run(lambda count: None, 1000)
    assert "x.zip" not in names(tmp_path)


@pytest.mark.parametrize(
    "place", ["file:///etc/passwd", "ftp://127.0.0.1/x", "data:,PK", "http://", VAL]
)
def test_a_redirection_that_leads_to_no_web_server_or_nowhere_is_refused_at_once(
    site: Site, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.redirect[VAL] = place
    for name in ("BACKOFF_S", "LONGEST_WAIT_S"):  # the error would wait, if it were sent again
        monkeypatch.setenv(f"CARLASC_REMOTE_{name}", "10000")
    with raises(
        CarlascError, where="val_cartesian.zip", expected="a file", found="a redirection in a loop"
    ):
        get(site, tmp_path)
    assert names(tmp_path) == []


def test_bytes_under_a_wrong_content_range_are_never_taken(site: Site, tmp_path: Path) -> None:
    site.shift_range = 16
    with raises(CarlascError, problem="last with expected bytes"):
        get(site, tmp_path)
    assert "val_cartesian.zip" not in names(tmp_path)


def test_a_file_without_an_etag_is_fetched_whole_and_not_continued(
    site: Site, tmp_path: Path
) -> None:
    site.etags = False

    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(site, tmp_path, progress=stop)
    site.files[VAL] = make_zip(1)
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_a_damaged_record_of_an_earlier_run_is_no_obstacle(site: Site, tmp_path: Path) -> None:
    (tmp_path / "val_cartesian.zip.part").write_bytes(b"x" * len(site.files[VAL]))
    (tmp_path / "val_cartesian.zip.part.json").write_text('{"url": 3, "got": []')
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_a_redirect_is_followed_with_its_range(site: Site, tmp_path: Path) -> None:
    site.files["/elsewhere"] = site.files.pop(VAL)
    site.redirect[VAL] = "/elsewhere"
    assert get(site, tmp_path).read_bytes() == site.files["/elsewhere"]
    assert all(site.requests)


def test_a_page_instead_of_the_zip_is_refused_at_the_first_request(
    site: Site, tmp_path: Path
) -> None:
    site.files[VAL], site.content_type = b"<html>gone</html>" * 500, "text/html"
    with raises(FormatError, expected="a zip", found="text/html"):
        get(site, tmp_path)
    assert names(tmp_path) == []


def test_a_missing_file_is_one_line_with_its_address(site: Site, tmp_path: Path) -> None:
    site.files.clear()
    with raises(MissingDataError, where="val_cartesian.zip", expected="a file", found="status 404"):
        get(site, tmp_path)


def test_an_existing_zip_is_not_fetched_again_and_another_is_not_overwritten(
    site: Site, tmp_path: Path
) -> None:
    path = get(site, tmp_path)
    count = len(site.requests)
    get(site, tmp_path)
    assert len(site.requests) == count + 1  # only the look at its size
    path.write_bytes(b"mine")
    with pytest.raises(ConflictError, match="move it away"):
        get(site, tmp_path)
    assert path.read_bytes() == b"mine"


def test_too_little_free_space_is_an_error_before_anything_is_written(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(
        extraction.shutil, "disk_usage", lambda _: usage._replace(free=len(site.files[VAL]) + 10)
    )
    with pytest.raises(CarlascError, match="free space for the zips and the files in them"):
        get(site, tmp_path, extract=True)
    assert names(tmp_path) == []
    assert get(site, tmp_path).exists()


def test_extracting_gives_the_files_removes_the_zip_and_is_not_done_twice(
    site: Site, tmp_path: Path
) -> None:
    assert not get(site, tmp_path, extract=True).exists()
    with zipfile.ZipFile(io.BytesIO(site.files[VAL])) as archive:
        for name in MEMBERS:
            assert (tmp_path / name).read_bytes() == archive.read(name)
    count = len(site.requests)
    result = download(tmp_path, split="val", base_url=site.url, extract=True)
    assert len(site.requests) == count
    assert result.archives[0].files == len(MEMBERS)


def test_extracting_can_keep_the_zip(site: Site, tmp_path: Path) -> None:
    assert get(site, tmp_path, extract=True, keep=True).exists()


def test_grids_are_extracted_to_a_folder_of_their_own(site: Site, tmp_path: Path) -> None:
    member = "Val/Town07_Light/cartesian/evaluation/000000.bin"
    site.files["/eval_fine.zip"] = make_zip(3, {member: 64})
    download(tmp_path, what="fine", base_url=site.url, extract=True, connections=3)
    assert (tmp_path / "eval_fine" / member).stat().st_size == 64


def test_the_table_answers_for_each_split_and_kind() -> None:
    def chosen(*splits: str, what: str = "sequences") -> list[str]:
        return [archive.name for archive in downloading.choose_archives(splits, what)]

    assert chosen("Train") == ["train_cartesian_13.zip", "train_cartesian_46.zip"]
    assert chosen("val", "test") == ["val_cartesian.zip", "test_cartesian.zip"]
    assert len(chosen("all")) == 4
    assert (
        chosen(what="cylindrical") == chosen("all", what="cylindrical") == ["eval_cylindrical.zip"]
    )
    assert all(archive.url.startswith("https://") for archive in downloading.ARCHIVES)


@pytest.mark.parametrize(
    ("splits", "what", "message"),
    [
        (("validation",), "sequences", "expected one of train, val, test, all"),
        ((), "sequences", "found none"),
        (("val",), "fine", "leave `split` out"),
        ((), "coarse", "what"),
    ],
)
def test_a_senseless_choice_is_an_argument_error(
    splits: tuple[str, ...], what: str, message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        downloading.choose_archives(splits, what)


def test_the_record_beside_a_part_names_the_file_and_its_blocks(site: Site, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(site, tmp_path, progress=stop)
    record = json.loads((tmp_path / "val_cartesian.zip.part.json").read_text())
    assert record["size"] == len(site.files[VAL])
    assert record["url"] == f"{site.url}{VAL}"
    part = (tmp_path / "val_cartesian.zip.part").read_bytes()
    for index, count in record["got"].items():
        start = int(index) * record["block"]
        assert part[start : start + count] == site.files[VAL][start : start + count]


@pytest.mark.parametrize("status", [401, 403, 404, 410])
def test_a_file_that_is_not_for_us_is_missing_at_the_first_try(
    site: Site, tmp_path: Path, status: int
) -> None:
    site.status = status
    with pytest.raises(MissingDataError, match=f"expected a file, found status {status}"):
        get(site, tmp_path)
    assert len(site.requests) == 1


def test_a_server_that_fails_is_asked_again(site: Site, tmp_path: Path) -> None:
    def fail_twice(number: int) -> None:
        site.status = 503 if number in (1, 4) else None

    site.before = fail_twice
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_a_server_that_always_fails_is_given_up(site: Site, tmp_path: Path) -> None:
    site.status = 503
    with raises(CarlascError, problem="failed at each attempt, last with 503"):
        get(site, tmp_path)
    assert len(site.requests) == 7


def test_weak_etags_are_compared_but_not_sent(site: Site, tmp_path: Path) -> None:
    site.weak = True
    assert get(site, tmp_path).read_bytes() == site.files[VAL]
    assert all(site.requests)  # in blocks: no range was refused


def test_with_weak_etags_a_file_that_changes_is_not_mixed(site: Site, tmp_path: Path) -> None:
    site.weak = True
    changed = make_zip(1)

    def change(number: int) -> None:
        if number == 5:
            site.files[VAL] = changed

    site.before = change
    assert get(site, tmp_path).read_bytes() == changed


def test_without_etags_a_change_of_size_begins_the_download_again(
    site: Site, tmp_path: Path
) -> None:
    site.etags = False
    changed = make_zip(2, {**MEMBERS, "Val/more": 3_000})

    def change(number: int) -> None:
        if number == 5:
            site.files[VAL] = changed

    site.before = change
    assert get(site, tmp_path).read_bytes() == changed


def test_a_stream_that_changes_begins_again(site: Site, tmp_path: Path) -> None:
    site.ranges = False
    changed = make_zip(2, {**MEMBERS, "Val/more": 3_000})

    def change(number: int) -> None:
        if number == 2:
            site.files[VAL] = changed

    site.before = change
    seen: list[int] = []
    assert (
        get(site, tmp_path, progress=lambda done, total: seen.append(done)).read_bytes() == changed
    )
    assert seen[-1] == len(changed)


@pytest.mark.parametrize("off", [-1, 1])
def test_a_length_that_is_not_that_of_the_range_is_not_believed(
    site: Site, tmp_path: Path, off: int
) -> None:
    site.length_off = off
    with raises(CarlascError, problem="found a Content-Length of"):
        get(site, tmp_path)
    assert "val_cartesian.zip" not in names(tmp_path)


def test_progress_goes_back_where_bytes_are_thrown_away(site: Site, tmp_path: Path) -> None:
    changed = make_zip(1)

    def change(number: int) -> None:
        if number == 5:
            site.files[VAL] = changed

    site.before = change
    seen: list[int] = []
    get(site, tmp_path, progress=lambda done, total: seen.append(done))
    assert seen[-1] == len(changed)
    site.ranges, site.before = False, None
    site.files[VAL] = make_zip(3)
    site.drop_after = 100_000
    with pytest.raises(CarlascError):
        get(site, tmp_path / "stream", progress=lambda done, total: seen.append(done))
    assert max(seen) <= len(changed)


def test_a_part_of_another_size_than_its_record_is_fetched_again(
    site: Site, tmp_path: Path
) -> None:
    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(site, tmp_path, progress=stop)
    part = tmp_path / "val_cartesian.zip.part"
    part.write_bytes(part.read_bytes()[:100])
    assert get(site, tmp_path).read_bytes() == site.files[VAL]


def test_keeping_without_extracting_is_an_argument_error(site: Site, tmp_path: Path) -> None:
    with raises(ArgumentError, where="keep", expected="`extract=True` too"):
        get(site, tmp_path, keep=True)


def test_no_connection_is_an_argument_error(tmp_path: Path) -> None:
    with raises(ArgumentError, where="connections", expected="1 or more", found="0"):
        download(tmp_path, split="val", connections=0)


def test_a_zip_that_exists_needs_no_space(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    get(site, tmp_path)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(
        extraction.shutil, "disk_usage", lambda _: usage._replace(free=len(site.files[VAL]) // 2)
    )
    get(site, tmp_path)
    with pytest.raises(
        CarlascError, match="to extract val_cartesian.zip|for the zips and the files"
    ):
        get(site, tmp_path, extract=True)


def test_the_result_says_how_long_it_took_and_an_address_may_end_in_a_slash(
    site: Site, tmp_path: Path
) -> None:
    result = download(tmp_path, split="val", base_url=f"{site.url}/", connections=3)
    assert result.elapsed_s > 0
    assert result.archives[0].fetched == result.archives[0].size == len(site.files[VAL])
