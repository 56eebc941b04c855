# carlasc with all extras for the CPU. In a checkout:
#     docker build -t carlasc .
#     docker run --rm -v "$PWD:/data" -u "$(id -u):$(id -g)" carlasc demo town
FROM python:3.11-slim AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.11-slim
COPY --from=build /wheels /wheels
COPY constraints.txt /wheels/
# [all] is quoted by the shell's pattern: there is one wheel
RUN pip install --no-cache-dir --constraint /wheels/constraints.txt "$(echo /wheels/*.whl)[all]"
# compiled code and settings of any user, who may have no home
ENV NUMBA_CACHE_DIR=/tmp/carlasc HOME=/tmp
WORKDIR /data
ENTRYPOINT ["carlasc"]
CMD ["--help"]
