# Two stages: wheels are built in the first; the second holds only Python, the installed packages and no build tools.
#   docker build -t beers-deploy .
#   docker run --rm --read-only --tmpfs /tmp --user "$(id -u):$(id -g)" -v "$PWD:/data" \
#     beers-deploy restore raw.tif restored.tif
FROM python:3.11.14-slim-bookworm AS build
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN pip install torch==2.13.0 --index-url "$TORCH_INDEX"
COPY pyproject.toml README.md LICENSE ./
COPY profiles profiles
COPY model model
COPY quant quant
COPY deploy deploy
RUN pip install . && pip uninstall --yes setuptools wheel pip

FROM python:3.11.14-slim-bookworm
RUN useradd --create-home --uid 1000 beers
COPY --from=build /opt/venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH HOME=/tmp PYTHONDONTWRITEBYTECODE=1
USER beers
WORKDIR /data
ENTRYPOINT ["beers-deploy"]
CMD ["--help"]
