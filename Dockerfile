# Runs `megastep` on a GPU with `docker run --gpus all`, otherwise on the CPU: docs/docker.md. There
# is no CUDA base image because PyTorch's wheels include NVRTC; g++ compiles the CPU kernels at first
# use. scripts/check_image.py builds it and tries it; no layer holds the source or what tests need.
ARG BASE=python:3.11.14-slim-bookworm
FROM ${BASE}
RUN apt-get update && apt-get install -y --no-install-recommends g++ libgomp1 && rm -rf /var/lib/apt/lists/*
ENV PIP_NO_CACHE_DIR=1 PIP_NO_DEPS=1 PIP_ROOT_USER_ACTION=ignore
ARG TORCH="--require-hashes -r /requirements/torch.txt"
RUN --mount=type=bind,source=requirements,target=/requirements pip install ${TORCH}
RUN --mount=type=bind,source=requirements,target=/requirements pip install --require-hashes -r /requirements/build.txt && pip install --require-hashes --no-build-isolation -r /requirements/packages.txt
RUN --mount=type=bind,target=/source mkdir /tmp/megastep && cd /source && cp -a pyproject.toml README.md LICENSE megastep agents configs /tmp/megastep && pip install --no-build-isolation /tmp/megastep && pip check && rm -rf /tmp/megastep
# Any user may run this image (docker run --user), so both folders are everybody's, like /tmp. They
# are no volumes: builders take the sticky bit from those, and the cache would not be trusted.
RUN useradd megastep && install -d -m 1777 /megastep /megastep/runs /cache
ENV HOME=/megastep USER=megastep XDG_CACHE_HOME=/cache
USER megastep
WORKDIR /megastep
ENTRYPOINT ["megastep"]
CMD ["train", "experiment=quickstart"]
