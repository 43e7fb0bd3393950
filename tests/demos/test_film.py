"""The film of an expert: the first command of README."""

import pytest
from torchcodec.decoders import VideoDecoder

from lerobot_constructskill.scripts.expert import FilmConfig, film

pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.mark.parametrize(("view", "size"), [("close", (720, 960)), ("policy", (224, 224))])
def test_an_episode_is_filmed_from_its_start_to_its_end(view, size, tmp_path):
    said = film(FilmConfig(out=tmp_path / "film.mp4", view=view))
    video = VideoDecoder(tmp_path / "film.mp4")
    first, last = video[0].float(), video[-1].float()
    assert said == f"{tmp_path / 'film.mp4'}: {len(video) / 20:.0f} s, placed"
    assert (video.metadata.height, video.metadata.width) == size
    assert first.std() > 10 and (first - last).abs().mean() > 1, "it shows something, and that moves"
