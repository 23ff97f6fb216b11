# Two images: `docker build --target nodes .` for plant, monitor and recorder, which never draw; `docker build .` for all
# commands, a third larger by the viewer.
# Pinned by version; `docs/deployment.md` has the command that gives the digest, to be put behind it as @sha256:...
ARG PYTHON_IMAGE=python:3.13.9-slim-trixie
FROM ${PYTHON_IMAGE} AS nodes

# A home of its own: compiled kernels and models are kept there. /recordings, /state and the cache are made here so that
# new volumes belong to the user; nothing else is written to, so the root may be read-only.
RUN useradd --create-home --uid 1000 reactorwatch \
    && install --directory --owner=reactorwatch /recordings /state /home/reactorwatch/.cache
ENV NUMBA_CACHE_DIR=/home/reactorwatch/.cache/numba

WORKDIR /app
COPY deploy/requirements.lock ./
# The lock without rerun-sdk: its line, and those of its hashes.
RUN sed '/^rerun-sdk==/,/[^\\]$/d' requirements.lock > nodes.lock
RUN pip install --no-cache-dir --require-hashes -r nodes.lock
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY reactorwatch ./reactorwatch
COPY plant_node ./plant_node
COPY monitor_node ./monitor_node
COPY recorder ./recorder
COPY diagnosis_node ./diagnosis_node
# `--build-arg COMMIT=$(git rev-parse HEAD)`: the context has no .git, and recordings say which build made them.
ARG COMMIT=unknown
RUN COMMIT=${COMMIT} pip install --no-cache-dir --no-deps --no-build-isolation .

USER reactorwatch
WORKDIR /home/reactorwatch
# Else each new container compiles for half a minute in the middle of a watch.
RUN python -m reactorwatch.codegen
STOPSIGNAL SIGTERM
ENTRYPOINT ["reactorwatch"]

FROM nodes AS full
USER root
RUN pip install --no-cache-dir --require-hashes -r /app/requirements.lock
USER reactorwatch
