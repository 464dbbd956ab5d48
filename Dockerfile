# NVRTC comes with PyTorch, so no CUDA base image; run with --gpus all to use a GPU, without to use the CPU.
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends g++ libgomp1 && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir -c constraints.txt torch==2.13.0 && pip install --no-cache-dir -c constraints.txt . && rm -rf /source
WORKDIR /megastep
VOLUME /megastep/runs
ENTRYPOINT ["megastep"]
CMD ["train", "experiment=quickstart"]
