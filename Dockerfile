# The service in a container that holds the program and nothing else of ours, and runs as nobody in particular.
#
#     docker build -t vpd .
#     docker run -p 127.0.0.1:8080:8080 -v vpd-data:/data -e VPD_TOKENS='admin A-LONG-SECRET' vpd
#
# tests/clients/dockerfile.py carries out these lines without Docker.
FROM rust:1.95-bookworm AS build
WORKDIR /src
COPY . .
RUN cargo build --release --locked --bin vpd

FROM debian:bookworm-slim
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
