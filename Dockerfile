# Runs `megastep` on a GPU with `docker run --gpus all`, otherwise on the CPU. There is no CUDA base
# image because PyTorch's wheels include NVRTC; g++ compiles the CPU kernels at first use.
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends g++ libgomp1 && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir -c constraints.txt torch==2.13.0 && pip install --no-cache-dir -c constraints.txt . && rm -rf /source
WORKDIR /megastep
VOLUME /megastep/runs
ENTRYPOINT ["megastep"]
CMD ["train", "experiment=quickstart"]
