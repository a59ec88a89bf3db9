# The service in a container that holds the program and nothing else of ours, and runs as nobody in particular.
#
#     docker build -t vpd .
#     TOKEN=$(head -c 24 /dev/urandom | base64)
#     docker run -p 127.0.0.1:8080:8080 -v vpd-data:/data -e VPD_TOKENS="admin $TOKEN" vpd
#
# docs/operations.md says how to pin the images that it is built from. tests/clients/dockerfile.py carries out these
# lines without Docker.
ARG BUILD_IMAGE=rust:1.95-bookworm
ARG BASE_IMAGE=debian:bookworm-slim
FROM ${BUILD_IMAGE} AS build
WORKDIR /src
COPY . .
# With tables as Parquet and Arrow (vpd export), and for many machines (vpd worker, vpd serve --engine cluster).
RUN cargo build --release --locked --bin vpd --features parquet,cluster,s3

FROM ${BASE_IMAGE}
RUN groupadd --system --gid 991 vpd && useradd --system --uid 991 --gid vpd --no-create-home vpd \
    && install -d -o vpd -g vpd -m 700 /data
COPY --from=build /src/target/release/vpd /usr/local/bin/vpd
ENV VPD_LISTEN=0.0.0.0:8080 VPD_DATA=/data
VOLUME /data
EXPOSE 8080
USER vpd
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=5s CMD ["bash", "-c", "exec 3<>/dev/tcp/127.0.0.1/8080 && printf 'GET /readyz HTTP/1.1\\r\\nHost: localhost\\r\\nConnection: close\\r\\n\\r\\n' >&3 && grep -q '^HTTP/1.1 200' <&3"]
ENTRYPOINT ["vpd"]
CMD ["serve"]
