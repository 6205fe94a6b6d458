"""The commands about published agents: the signature is the command line, the docstring the help."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from dds_lightning.console.reports import Report, pairs, table
from dds_lightning.errors import UserError
from dds_lightning.saving.places import is_hub, refuse_no_folder


def publish(
    run: str,
    place: str,
    skill: str | None = None,
    policy: str | None = None,
    task: str | None = None,
    card: str | None = None,
    public: bool = False,
    replace: bool = False,
) -> Report:
    """Publish an agent as a directory that others can load and trust, or push it to the Hugging Face Hub.

    The directory holds the weights (safetensors), settings, scores, a card (for a run, it says which stage loses) and
    the hashes of all files; nothing in it is ever executed. It is verified before it is moved into place.

    Args:
        run: A run of `dds run`, or a published directory; "-" with --skill.
        place: A directory, or hf:OWNER/NAME; another agent that is there stays, see --replace.
        skill: Skill checkpoint (.ckpt) instead of a run.
        policy: Policy checkpoint (.ckpt) to go with it, of `dds policy fit` or `dds online fit`; one over raw actions
            comes without --skill.
        task: Name of the task to keep with it; without it the one that the run or the checkpoints were trained for.
        card: A text file for README.md; without it the run's card.
        public: Make a new repository on the Hub public.
        replace: Replace another agent that was published in that directory.
    """
    if run != "-" and skill is None and policy is None:
        refuse_no_folder(run)
    from dds_lightning.agent import DDSAgent
    from dds_lightning.saving.hub import push
    from dds_lightning.saving.published import CARD, load_published, refuse_another
    from dds_lightning.saving.untrusted import read_text
    from dds_lightning.sharing.verify import verify_published
    from dds_lightning.study.card import with_diagnosis
    from dds_lightning.study.contestants import agent_directory
    from dds_lightning.study.loose import loose_agent, loose_task
    from dds_lightning.tasks import facts_to_keep, get_task, restore_task

    parts = skill is not None or policy is not None
    if policy is not None and skill is None and run != "-":
        raise UserError(f"--policy is {policy} without --skill: give both")
    if (run == "-") != parts:
        raise UserError(f"run is '{run}' and --skill is {skill}: give a run, or - and --skill CHECKPOINT")
    chosen = None if task is None else get_task(task)
    text = None if card is None else _text(card)
    if parts:
        chosen = loose_task(task, policy, skill)
        agent = loose_agent(skill, policy, chosen)
        about, metrics = {"task": None} if chosen is None else facts_to_keep(chosen), None
    else:
        source = agent_directory(Path(run))
        published = load_published(source)
        agent = DDSAgent.load(source)
        chosen = chosen or restore_task(published.config, source)
        about, metrics = {"task": None} if chosen is None else facts_to_keep(chosen), dict(published.metrics)
        if text is None:
            text = read_text(source / CARD)
            if (Path(run) / "report").is_dir():
                text = with_diagnosis(text, Path(run))
    if is_hub(place):
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            saved = agent.save(Path(folder) / "agent", metrics=metrics, card=text, **about)
            facts = {**verify_published(saved), "directory": push(saved, place, private=not public)}
    else:
        if not replace:
            refuse_another(place, agent.state_dict())
        facts = verify_published(agent.save(place, metrics=metrics, card=text, **about))
    return Report(facts, [pairs(facts.items()), f'load it with DDSAgent.load("{place}")'])


def list_(
    directory: list[str] = [],  # noqa: B006 - jsonargparse shows the default
    root: list[str] = ["checkpoints", "runs"],  # noqa: B006
) -> Report:
    """List published agents under some folders, with what is wrong with them, if anything.

    Args:
        directory: Folders to look in.
        root: The folders where none are given.
    """
    from dds_lightning.sharing.verify import find_published

    root = directory or root
    if missing := [folder for folder in directory if not Path(folder).is_dir()]:
        raise UserError(f"there is no folder {missing[0]}: give folders with published agents")
    found = find_published(root)
    if found.empty:
        return Report(found, [f"no published agents in {', '.join(root)}; `dds run` and `dds publish` make some"])
    return Report(found, [table(found)])


def verify(directory: str) -> Report:
    """Check everything in a published directory: hashes, header, shapes, finite numbers, known answers.

    If it is not sound, the message says what is wrong and the exit status is 2.

    Args:
        directory: A published directory, or hf:OWNER/NAME.
    """
    from dds_lightning.saving.hub import pull
    from dds_lightning.sharing.verify import verify_published

    facts = verify_published(pull(directory) if is_hub(directory) else directory)
    return Report(facts, [f"{directory} is sound: {_summary(facts)}"])


def export(
    directory: str,
    out: str | None = None,
    format: Literal["onnx", "torch"] = "onnx",
    selection: Literal["sample", "greedy", "argmax_q"] | None = None,
    temperature: float | None = None,
    noise_scale: float | None = None,
) -> Report:
    """Export an agent as one file that acts without this package, and compare the two.

    The file takes observations, codes in use (-1: choose), Gumbel noise for the choice and Gaussian noise for the
    decoder, and gives actions and codes; its metadata hold horizon and sizes. `dds_lightning/examples` has a program
    that acts with it.

    Args:
        directory: A run of `dds run`, a published directory, or hf:OWNER/NAME.
        out: The file; without it NAME.onnx or NAME.pt2 in the current folder.
        format: Either onnx (any language), or torch (`torch.export.load`).
        selection: How skills are chosen; without it as the agent does.
        temperature: Sampling temperature; without it the agent's.
        noise_scale: Factor on the decoder's noise; without it the agent's.
    """
    if not is_hub(directory):
        refuse_no_folder(directory)
    from dds_lightning.agent import DDSAgent
    from dds_lightning.saving.hub import pull
    from dds_lightning.saving.published import load_published
    from dds_lightning.sharing.export import SUFFIXES, check_exported, describe, export_agent
    from dds_lightning.study.contestants import agent_directory

    source = pull(directory) if is_hub(directory) else agent_directory(Path(directory))
    chosen = {"selection": selection, "temperature": temperature, "noise_scale": noise_scale}
    agent = DDSAgent.load(source, **{name: value for name, value in chosen.items() if value is not None})
    task = load_published(source).config.get("task")
    name = Path(directory.removeprefix("hf:")).name
    path = export_agent(agent, out or f"{name}{SUFFIXES[format]}", format, task=task)
    found = check_exported(agent, path)
    facts = {"file": str(path), "format": format, "megabytes": round(path.stat().st_size / 1e6, 2)}
    data = {**facts, **describe(agent, task), **found}
    times = {
        "largest difference": f"{found['difference']:.1g}",
        "one act, the file": f"{found['file_ms']['median']:.2f} ms (95 %: {found['file_ms']['p95']:.2f})",
        "one act, the agent": f"{found['agent_ms']['median']:.2f} ms (95 %: {found['agent_ms']['p95']:.2f})",
    }
    return Report(data, [pairs({**facts, **describe(agent, task), **times}.items())])


def _summary(fact: dict[str, Any]) -> str:
    golden = fact["golden"]
    answers = "it stores no answers to compare" if golden is None else f"answers as published (within {golden:.1g})"
    holds = f"{fact['num_skills']} skills" if fact["num_skills"] else f"a {' and a '.join(fact['stages'])} model"
    return f"task {fact['task']}, {fact['parameters']:,} parameters, {holds}; {answers}"


def _text(card: str) -> str:
    try:
        return Path(card).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--card: {card} cannot be read as text ({error})") from error
