# On the CPU: docker build --file docker/cpu.Dockerfile --tag mjx-reinforce .
#             docker run --rm --volume "$PWD/runs:/runs/runs" mjx-reinforce --env Hopper-v5
# The image has the package alone: the wheel is built in a stage of its own.
FROM python:3.12-slim AS build
RUN apt-get update && apt-get install --yes --no-install-recommends git && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir build
COPY . /source
RUN git config --global --add safe.directory /source && python -m build --wheel --outdir /dist /source

FROM python:3.12-slim
# Films are drawn by Mesa, without a screen.
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libgl1-mesa-dri libglib2.0-0 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl
COPY --from=build /dist /dist
COPY constraints.txt /dist/constraints.txt
RUN pip install --no-cache-dir --constraint /dist/constraints.txt "$(ls /dist/*.whl)[video]"
RUN useradd --create-home trainer && mkdir /runs && chown trainer /runs
USER trainer
WORKDIR /runs
ENTRYPOINT ["python", "-m", "mjx_reinforce.train"]
