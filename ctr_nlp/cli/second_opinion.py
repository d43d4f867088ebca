"""The checker's opinions on a plan's file beside the plan's own verdicts, cached by the file's content."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import ctr_nlp.check
from ctr_nlp.check.checker import CheckResult, Finding
from ctr_nlp.check.comparison import Opinion, compare_verdicts
from ctr_nlp.check.plan_file import CheckError, PlanFile, read_plan_file
from ctr_nlp.check.records import check_plan
from ctr_nlp.codegen.cache import folder
from ctr_nlp.exceptions import OutputError, TrajectoryError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.atomic_write import write_atomically


def form_opinions(path: str | Path, samples: int = 0, centreline: str | None = None) -> list[Opinion]:
    """Check a plan's file, and set what is found beside the plan's own verdicts.

    path: of a plan.npz. samples: how many simulated robots are moved. centreline: file that the plan was made for,
    to check its axes. A file that the package refuses to read is checked all the same, without own verdicts.
    Raises OutputError where a file cannot be read at all.
    """
    try:
        found = check_plan(path, samples, centreline) if centreline else _check_once(Path(path), samples)
    except CheckError as error:
        raise OutputError(str(error)) from error
    try:
        own = Plan.load(path).verdicts._asdict()
    except OutputError as error:
        refused = Opinion("readable", "no", None, "yes", None, False, f"The package refuses the file: {error}")
        return [*compare_verdicts(found, {}), refused]
    return compare_verdicts(found, own)


def _check_once(path: Path, samples: int) -> CheckResult:
    """Check a plan's file, or take the findings that an earlier check of the same content left in the cache."""
    file = read_plan_file(path)
    place = folder() / "checked" / f"{_cache_key(file, samples)}.json"
    try:
        kept = json.loads(place.read_text(encoding="utf-8"))
        findings = {name: Finding(*finding) for name, finding in kept["findings"].items()}
        return CheckResult(file, findings, kept["snaps"], kept["moved"], kept["borderline"])
    except (OSError, LookupError, TypeError, ValueError):
        found = check_plan(path, samples)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with write_atomically(place) as partial:
            kept = {name: getattr(found, name) for name in ("findings", "snaps", "moved", "borderline")}
            partial.write_text(json.dumps(kept), encoding="utf-8")
    except OSError:  # a folder that cannot be written costs time, and nothing else
        pass
    return found


def _cache_key(file: PlanFile, samples: int) -> str:
    """Return what findings depend on, as one name: the file's content, the samples, and the checker's own code."""
    key = hashlib.sha256(f"{file.content_digest} {file.digest} {samples}".encode())
    for source in sorted(Path(ctr_nlp.check.__file__).parent.glob("*.py")):
        key.update(source.read_bytes())
    return key.hexdigest()


def require_agreement(path: str | Path) -> list[Opinion]:
    """Return the checker's opinions on the file of a plan that is to be played.

    Raises TrajectoryError where the checker disagrees with the plan, or cannot read it.
    """
    try:
        opinions = form_opinions(path)
    except OutputError as error:
        raise TrajectoryError(f"the plan was not played, since the checker cannot read it: {error}") from error
    apart = [each for each in opinions if not each.agrees]
    if apart:
        raise TrajectoryError(
            f"the plan was not played, since an independent check disagrees. {' '.join(map(_in_words, apart))} "
            f"`ctr-nlp check {path}` shows both; make the plan again, or report the difference"
        )
    return opinions


def _in_words(opinion: Opinion) -> str:
    """Return a sentence on what a plan and the checker say of one matter."""
    name = opinion.name.replace("_", " ")
    if opinion.own_word is None:
        return f"Record of {name}: {opinion.why}"
    own, found = (
        word if number is None else f"{word} ({number:.4g})"
        for word, number in ((opinion.own_word, opinion.own_number), (opinion.word, opinion.number))
    )
    return f"{name}: the plan says {own}, the checker {found}. {opinion.why.rstrip('.')}."
