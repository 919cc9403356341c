# On NVIDIA GPUs, with NVIDIA's container toolkit on the host:
#   docker build --file docker/cuda.Dockerfile --tag mjx-reinforce:cuda .
#   docker run --rm --gpus all --volume "$PWD/runs:/runs/runs" mjx-reinforce:cuda --env Hopper-v5
# CUDA comes with JAX's wheels; the driver comes from the host.
# The image has the package alone: the wheel is built in a stage of its own.
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install --yes --no-install-recommends git && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir build
COPY . /source
RUN git config --global --add safe.directory /source && python -m build --wheel --outdir /dist /source

FROM python:3.12-slim
# Films are drawn by the GPU's EGL.
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl
COPY --from=build /dist /dist
COPY constraints.txt /dist/constraints.txt
RUN pip install --no-cache-dir --constraint /dist/constraints.txt "$(ls /dist/*.whl)[cuda,video]"
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
RUN useradd --create-home trainer && mkdir /runs && chown trainer /runs
USER trainer
WORKDIR /runs
ENTRYPOINT ["python", "-m", "mjx_reinforce.train"]
