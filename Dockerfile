# Two images:
#
#   docker build --target actor -t udrl .              actors and the replay service; no torch
#   docker build --target learner -t udrl-learner .    the same with torch: learners
#
# BASE_IMAGE   a slim image with Python 3.11 or newer as python3, python:3.11-slim-bookworm by default;
#              what runs is built on it
# BUILD_IMAGE  the same, with what pip needs to reach a package index here; by default just the same
# TORCH_INDEX  for the learner: an index of CPU-only torch wheels, which saves gigabytes without a GPU
ARG BASE_IMAGE
ARG BUILD_IMAGE

# What changes rarely comes first, so that a change of code fetches nothing again.
FROM ${BUILD_IMAGE:-${BASE_IMAGE:-python:3.11-slim-bookworm}} AS dependencies
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
RUN python3 -m venv /opt/udrl
COPY pyproject.toml constraints.txt ./
RUN python3 -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
extras = p["optional-dependencies"]; \
print(*p["dependencies"], *extras["box2d"], *extras["doom"], *extras["secure"], sep="\n")' \
        > requirements.txt \
    && /opt/udrl/bin/pip install --constraint constraints.txt --requirement requirements.txt

FROM dependencies AS build
COPY README.md LICENSE ./
COPY udrl udrl
COPY proto proto
COPY services services
COPY experiments experiments
# Nothing is installed later.
RUN /opt/udrl/bin/pip install --no-deps . \
    && /opt/udrl/bin/pip uninstall --yes pip setuptools

FROM ${BASE_IMAGE:-python:3.11-slim-bookworm} AS actor
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin udrl \
    && mkdir -p /runs /keys/ca /keys/replay /keys/learner /keys/actor /keys/observer \
    && chown -R udrl:udrl /runs /keys
COPY --from=build /opt/udrl /opt/udrl
ENV PATH=/opt/udrl/bin:$PATH HOME=/tmp PYTHONUNBUFFERED=1
USER udrl
WORKDIR /runs
ENTRYPOINT ["udrl"]

# In a folder of its own, which the code above does not touch. Nothing is built against torch here.
FROM dependencies AS torch
ARG TORCH_INDEX=
RUN python3 -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
print(*p["optional-dependencies"]["train"], sep="\n")' > train.txt \
    && /opt/udrl/bin/pip install --target /opt/torch --constraint constraints.txt \
        ${TORCH_INDEX:+--extra-index-url ${TORCH_INDEX}} --requirement train.txt \
    && rm -rf /opt/torch/torch/include /opt/torch/setuptools* /opt/torch/bin

FROM actor AS learner
COPY --from=torch /opt/torch /opt/torch
ENV PYTHONPATH=/opt/torch
