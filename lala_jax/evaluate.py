"""Score a policy in closed loop: `python -m lala_jax.evaluate --checkpoint=runs/tower/checkpoints --split=test --episodes=100`.

The config comes from the checkpoint; `--config.camera.preset=paper` and the like change it. Of `--split`, `--start` and `--episodes` what
is not given (-1) is the config's. `--checkpoint=pretrained/tower` repeats the reported score of the weights that ship with the package,
and ends with status 1 where it comes out outside the reported interval. The agents that need no training are scored with
`--config=configs/tower.py --agent=oracle`, `blind` or `top_view`. With `--launcher=slurm` or `local` workers score the episodes in
parts (see `cluster`).
"""

from __future__ import annotations

import pathlib
import shutil
from collections.abc import Mapping, Sequence
from typing import Any

from lala_jax import build, cluster, compiling, options, pretrained, scoring, writers

UNSET = -1  # of a number: the config's
FLAGS = {"checkpoint": "", "agent": "policy", "split": "", "start": UNSET, "episodes": UNSET, **cluster.FLAGS}
NO_CHECKPOINT = "give --checkpoint=PATH, or --config=FILE.py with --agent=oracle, blind or top_view"


def main(
    config, workdir, *, checkpoint: str, agent: str, split: str, start: int, episodes: int, launcher: str, launcher_options: str
) -> dict[str, Any]:
    """Score the checkpoint, or an agent that needs no training, and write scores and pictures to the work directory."""
    options.check_choice("--agent", agent, scoring.AGENTS)
    launch, split = cluster.launcher(launcher, launcher_options), split or config.eval.split
    start, episodes = (config.eval[name] if given == UNSET else given for name, given in (("start", start), ("episodes", episodes)))
    seeds = build.split_seeds(split, start, episodes)
    build.check_evaluation(config)
    out = pathlib.Path(build.workdir(config, workdir))
    parts = out / f"scores-{agent}-{split}.parts"
    writers.make_directory(out)
    result, strips, weights = score(config, checkpoint, agent, seeds, launch, parts)
    source = checkpoint if agent == "policy" else None
    scoring.write_scores(config, result, strips, out, agent=agent, split=split, seeds=seeds, source=source, weights=weights)
    if launch is not None:
        shutil.rmtree(parts)
    if agent == "policy" and not reproduced(checkpoint, config, split=split, seeds=seeds, result=result):
        raise SystemExit(1)
    return result


def score(config, checkpoint: str, agent: str, seeds: Sequence[int], launch: cluster.Launcher | None, parts: pathlib.Path):
    """Score here or by workers, which leave parts: the summary, the pictures and what identifies the weights."""
    weights = None
    if agent == "policy":
        if not checkpoint:
            raise options.OptionsError(NO_CHECKPOINT)
        built, observer = build.build_policy(config), build.observer(config)
        params = scoring.check_checkpoint(checkpoint, config, built)
        weights = pretrained.fingerprint(checkpoint, params)
        if launch is None:
            result, strips = scoring.evaluate(
                built, params, observer, seeds=seeds, parallel=config.eval.parallel, threads=config.data.threads,
                strips=config.eval.strips, seed=config.seed, progress=lambda done, total: print(f"{done} of {total} episodes", flush=True),
            )  # fmt: skip
            return result, strips, weights
    if launch is None:
        return scoring.baseline(agent, build.task(config), seeds=seeds, threads=config.data.threads), {}, None
    return *scoring.evaluate_in_parts(launch, config, parts, agent=agent, path=checkpoint, weights=weights, seeds=seeds), weights


def reproduced(path: str, config, *, split: str, seeds: Sequence[int], result: Mapping[str, Any]) -> bool:
    """Print how the score compares with the one that published weights report; False only where it contradicts that."""
    card = pretrained.card(path)
    if card is None:
        return True
    fine, text = pretrained.verdict(card, writers.plain(options.to_dict(config)), split=split, seeds=seeds, result=result)
    print(text, flush=True)
    return fine


def stored_config(flags: Mapping[str, Any]):
    """Give the config that a checkpoint, or a card of published weights, holds."""
    if not flags["checkpoint"]:
        raise options.OptionsError(NO_CHECKPOINT)
    stored = options.from_dict(pretrained.describe(flags["checkpoint"])["config"])
    return options.override(stored, ["data.threads=0"])  # it may be the number of cores of another machine


if __name__ == "__main__":
    compiling.keep()
    options.run(
        main,
        flags=FLAGS,
        config_from=stored_config,
        workdir=build.WORKDIR + "/eval",
        user_errors=build.USER_ERRORS,
    )
