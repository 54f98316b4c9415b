# The pipeline on a CPU, from the same pinned versions as `make setup`. It was written beside that and not built here: no Docker was
# at hand. A source of CPU builds of torch makes the image 4 GB smaller; see docs/install.md.
#
#     docker build -t physics3d .
#     docker run --rm -v "$PWD:/work" physics3d run scene=carnation profile=smoke
#     docker build --build-arg PIP_EXTRA_INDEX_URL=<address of a source of CPU builds> -t physics3d .
FROM python:3.11-slim

ARG PIP_EXTRA_INDEX_URL
ENV PIP_CONSTRAINT=/opt/physics3d/constraints.txt PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 SAM2_BUILD_CUDA=0
RUN apt-get update && apt-get install -y --no-install-recommends git g++ libgomp1 libx11-6 libgl1 \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/physics3d
COPY constraints.txt ./
RUN pip install setuptools wheel && pip install torch torchvision
COPY pyproject.toml setup.py README.md LICENSE ./
COPY conf conf
COPY physics3d physics3d
COPY stages stages
COPY pipeline pipeline
RUN pip install --no-build-isolation '.[pipeline,priors,sam,sfm,view,export,dask]'

# results, data and compiled kernels stay in the folder that is mounted here
WORKDIR /work
ENV OMP_NUM_THREADS=1 WARP_CACHE_PATH=/work/.warp
ENTRYPOINT ["physics3d"]
CMD ["--help"]
