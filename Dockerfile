# Three stages: the first installs by hash, the second lists what was installed, the third holds only Python and that.
#   docker build -t beers-deploy .                                                     every command
#   docker build -t beers-deploy:core --build-arg LOCK=requirements-core.lock .        without PyTorch and plots:
#     restore, simulate, check, bench, quantize, gate, golden
#   docker run --rm --read-only --tmpfs /tmp --network none --user "$(id -u):$(id -g)" -v "$PWD:/data" \
#     beers-deploy restore raw.tif restored.tif
# The tag is for people; what is pulled is the digest (docker buildx imagetools inspect TAG shows a tag's present one).
FROM python:3.11.14-slim-bookworm@sha256:65a93d69fa75478d554f4ad27c85c1e69fa184956261b4301ebaf6dbb0a3543d AS base

FROM base AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG LOCK=requirements.lock
WORKDIR /src
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
COPY requirements.lock requirements-core.lock ./
RUN pip install --only-binary :all: --no-deps --require-hashes --extra-index-url "$TORCH_INDEX" -r "$LOCK"
COPY pyproject.toml setup.py README.md LICENSE ./
COPY profiles profiles
COPY model model
COPY quant quant
COPY deploy deploy
RUN pip install --no-index --no-deps --no-build-isolation . && pip check && pip uninstall --yes setuptools pip

# A stage of its own: what makes the list cannot touch what is listed.
FROM base AS sbom
RUN python -m venv /opt/tool && /opt/tool/bin/pip install --no-cache-dir cyclonedx-bom==7.5.0
COPY --from=build /opt/venv /opt/venv
COPY pyproject.toml ./
RUN /opt/tool/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o /sbom.cdx.json /opt/venv

FROM base
RUN useradd --create-home --uid 1000 beers
COPY --from=build /opt/venv /opt/venv
COPY --from=sbom /sbom.cdx.json /opt/venv/share/sbom.cdx.json
ENV PATH=/opt/venv/bin:$PATH HOME=/tmp PYTHONDONTWRITEBYTECODE=1 ORT_DISABLE_TELEMETRY=1
USER 1000:1000
WORKDIR /data
ENTRYPOINT ["beers-deploy"]
CMD ["--help"]
