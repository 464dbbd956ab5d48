# Runs `megastep` on a GPU with `docker run --gpus all`, otherwise on the CPU: docs/docker.md. There
# is no CUDA base image because PyTorch's wheels include NVRTC; g++ compiles the CPU kernels at first
# use. scripts/check_dockerfile.py runs these lines without Docker.
ARG BASE=python:3.11.14-slim-bookworm
FROM ${BASE}
RUN apt-get update && apt-get install -y --no-install-recommends g++ libgomp1 && rm -rf /var/lib/apt/lists/*
ENV PIP_NO_CACHE_DIR=1 PIP_NO_DEPS=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /source
COPY requirements requirements
RUN pip install --require-hashes -r requirements/build.txt
RUN pip install --require-hashes --no-build-isolation -r requirements/packages.txt
ARG TORCH="--require-hashes -r requirements/torch.txt"
RUN pip install ${TORCH}
COPY . .
RUN pip install --no-build-isolation . && pip check && rm -rf /source/*
# Any user may run this image (docker run --user), so both folders are everybody's, like /tmp.
RUN useradd megastep && install -d -m 1777 /megastep /megastep/runs /cache
ENV HOME=/megastep USER=megastep XDG_CACHE_HOME=/cache
USER megastep
WORKDIR /megastep
VOLUME ["/megastep/runs", "/cache"]
ENTRYPOINT ["megastep"]
CMD ["train", "experiment=quickstart"]
