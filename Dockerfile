# On CPUs, small: docker build --build-arg TORCH_INDEX=URL -t etsplat . (URL: PyTorch's index of CPU builds, without which torch brings
#   several GB of CUDA); docker run --rm -v "$PWD:/data" etsplat reconstruct my_scene/ --out runs/scene
# On NVIDIA GPUs: docker build --build-arg EXTRAS=cuda,sfm,texture,video,viewer -t etsplat .; docker run --gpus all and so on
FROM python:3.12-slim-bookworm AS build
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
# hadolint ignore=DL3042
RUN python -m pip wheel --no-deps --wheel-dir /wheels .

FROM python:3.12-slim-bookworm
ARG TORCH_INDEX
ARG EXTRAS=sfm,texture,video,viewer
COPY --from=build /wheels /wheels
COPY constraints.txt /wheels/
RUN python -m pip install --no-cache-dir --no-compile ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} --constraint /wheels/constraints.txt torch \
    && python -m pip install --no-cache-dir --no-compile "$(echo /wheels/*.whl)[$EXTRAS]" \
    && rm -rf /wheels \
    && useradd --create-home --uid 1000 etsplat
USER 1000
WORKDIR /data
ENTRYPOINT ["etsplat"]
CMD ["--help"]
