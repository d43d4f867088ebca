"""The named problems, a file each: a robot and a target, nothing else. Installed as `ctr_nlp.problems`."""

from ctr_nlp.paths.named_problems import PROBLEM_NAMES, named_problem

named = named_problem  # the short name that published examples use

__all__ = ["PROBLEM_NAMES", "named", "named_problem"]
