"""Where the packages are; everything else stands in pyproject.toml.

The named problems are the folder `problems` at the top of the repository, and are installed as `ctr_nlp.problems`.
"""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["ctr_nlp*"]), "ctr_nlp.problems"],
    package_dir={"ctr_nlp.problems": "problems"},
)
