"""Which folders are installed: the three packages, and conf/ as pipeline/conf. The rest is said in pyproject.toml."""

from setuptools import find_namespace_packages, setup

setup(
    packages=[*find_namespace_packages(include=["physics3d*", "stages*", "pipeline*"]), "pipeline.conf"],
    package_dir={"pipeline.conf": "conf"},
    package_data={
        "pipeline.conf": ["**/*.yaml"],
        "pipeline": ["pages/*"],
        "physics3d.scenes": ["motions/*.npz"],  # made by make reference-motion
        "physics3d.priors": ["tiny_video_weights/*"],  # made by make train-prior
    },
)
