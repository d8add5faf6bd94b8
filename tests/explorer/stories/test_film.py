"""Films of stories: what is written, and what is refused before anything is computed. `tests/e2e` records one."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL.WebPImagePlugin import WebPImageFile

from explorer.cli import StoryCommand
from explorer.stories import film
from explorer.stories.film import Take
from explorer.stories.story import Step, Story
from lpn.core.demo import DEMO
from lpn.core.errors import InputError

RED, BLUE = (200, 30, 30), (30, 30, 200)
STORY = Story("One", (Step("query=0001"),))


def takes() -> list[Take]:
    return [Take(np.full((320, 480, 3), colour, np.uint8), seconds) for colour, seconds in ((RED, 1.0), (BLUE, 2.0))]


def near(pixel: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool(np.abs(pixel.astype(int) - colour).max() < 12)


def test_an_mp4_holds_each_step_for_its_seconds_and_fades_between(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="needs PyAV, extra film")
    film.write(takes(), tmp_path / "film.mp4")
    with av.open(tmp_path / "film.mp4") as opened:
        frames = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
        assert opened.streams.video[0].average_rate == film.RATE
    assert len(frames) == 3 * film.RATE + film.FADE - 1
    assert near(frames[0][0, 0], RED)
    assert near(frames[film.RATE - 1][0, 0], RED)
    assert near(frames[film.RATE + film.FADE // 2 - 1][0, 0], (115, 30, 115))
    assert near(frames[-1][0, 0], BLUE)


def test_a_webp_moves_in_the_same_way_and_repeats(tmp_path: Path) -> None:
    film.write(takes(), tmp_path / "film.webp")
    with WebPImageFile(tmp_path / "film.webp") as opened:
        assert (opened.n_frames, opened.size, opened.info["loop"]) == (film.FADE + 1, (480, 320), 0)
        assert near(np.asarray(opened.convert("RGB"))[0, 0], RED)
        assert opened.info["duration"] == 1000
        opened.seek(opened.n_frames - 1)
        assert near(np.asarray(opened.convert("RGB"))[0, 0], BLUE)


@pytest.mark.parametrize(("letters", "seconds"), [(0, film.SHORTEST), (90, 6.5), (4000, film.LONGEST)])
def test_a_caption_stands_as_long_as_it_takes_to_read(letters: int, seconds: float) -> None:
    assert film.reading_time("x" * letters) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("name", "story", "size", "message"),
    [
        ("film.gif", STORY, (1280, 800), r"film\.gif; expected a name that ends in \.mp4 or \.webp"),
        ("film.mp4", Story("Empty"), (1280, 800), "no step"),
        ("film.mp4", STORY, (1281, 800), "1281 x 800"),
        ("film.mp4", STORY, (1280, 80), "1280 x 80"),
    ],
)
def test_an_impossible_film_is_refused_and_leaves_no_file(
    name: str, story: Story, size: tuple[int, int], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        film.check_film(tmp_path / name, story, size)
    assert not list(tmp_path.iterdir())


def test_the_command_lists_the_stories(capsys: pytest.CaptureFixture[str]) -> None:
    if not DEMO.is_dir():
        pytest.skip("needs the demo")
    StoryCommand().run()
    assert capsys.readouterr().out.startswith("Found  (4 steps)\n")


def test_the_command_refuses_a_story_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="There is no story 'Lost'; there are Found, "):
        StoryCommand(name="Lost", record=tmp_path / "film.mp4").run()


def test_a_film_speaks_plain_words_unless_it_is_told_or_a_step_names_others() -> None:
    def words_of(shows: str, plain: bool) -> list[str]:
        query = parse_qs(urlsplit(film.address("http://host/?key=a", shows, True, plain)).query)
        assert (query["key"], query["theme"], query["screen"]) == (["a"], ["dark"], ["all"])
        return query["words"]

    assert words_of("query=a", True) == ["plain"]
    assert words_of("", False) == ["expert"]
    assert words_of("query=a&words=expert", True) == ["expert"]
    assert not StoryCommand().expert
