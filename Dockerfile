# etsplat on CPUs: docker build -t etsplat .; docker run --rm -v "$PWD:/data" etsplat reconstruct photos/ --out runs/photos
FROM python:3.12-slim-bookworm AS build
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .
# hadolint ignore=DL3042
RUN python -m pip wheel --no-deps --wheel-dir /wheels .

FROM python:3.12-slim-bookworm
# --build-arg TORCH_INDEX=URL: PyTorch's own index of CPU builds, without which torch brings several GB of CUDA.
ARG TORCH_INDEX
COPY --from=build /wheels /wheels
COPY constraints.txt /wheels/
RUN python -m pip install --no-cache-dir --no-compile ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} --constraint /wheels/constraints.txt torch \
    && python -m pip install --no-cache-dir --no-compile "$(echo /wheels/*.whl)[sfm,texture,video,viewer]" \
    && rm -rf /wheels \
    && useradd --create-home --uid 1000 etsplat
USER 1000
WORKDIR /data
ENTRYPOINT ["etsplat"]
CMD ["--help"]
