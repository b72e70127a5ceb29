"""Which packages are installed; everything else is in pyproject.toml.

Folders of the repository and the packages that they become: ``cli`` is installed as ``masiv.cli``, not as ``cli``.
Packages below them are discovered.
"""

from setuptools import find_packages, setup

FOLDERS = {"masiv": "masiv", "masiv.cli": "cli", "masiv.assets": "assets"}

setup(
    package_dir=FOLDERS,
    packages=[
        name
        for package, folder in FOLDERS.items()
        for name in (package, *(f"{package}.{inner}" for inner in find_packages(folder)))
    ],
)
