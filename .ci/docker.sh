# Sourced by .ci/run: installs and starts a Docker engine if none is running, on Debian as root.
#
# If the base image cannot be pulled, base and build images are made from Debian packages. The build image
# gets pip's certificates and wheel folders of this machine.
# Sets BASE_IMAGE and BUILD_IMAGE if it made images, ENGINE to the process if it started the engine, and
# NO_DOCKER to the reason if the containers cannot be tested.

docker_log=${TMPDIR:-/tmp}/udrl-docker.log

answers() {
    docker info >/dev/null 2>&1 && { docker compose version || docker-compose version; } >/dev/null 2>&1
}

engine() {
    answers && return
    NO_DOCKER="no Docker engine with Compose is running"
    [ "$(id -u)" = 0 ] && grep -qx ID=debian /etc/os-release || return 1
    NO_DOCKER="the engine cannot be installed; see $docker_log"
    export DEBIAN_FRONTEND=noninteractive
    timeout 600 apt-get -qq update >"$docker_log" 2>&1 || return 1
    timeout 600 apt-get -qq install --no-install-recommends docker.io docker-compose debootstrap iptables \
        >>"$docker_log" 2>&1 || return 1
    unset NO_DOCKER
    answers && return  # started by the package
    NO_DOCKER="the engine does not start; see $docker_log"
    setsid dockerd >>"$docker_log" 2>&1 &
    ENGINE=$!
    for _ in $(seq 60); do
        answers && { unset NO_DOCKER; return; }
        sleep 1
    done
    return 1
}

images() (
    # `set -e` has no effect before ||, so each step exits on failure, in a subshell.
    docker image inspect udrl-ci-base udrl-ci-build >/dev/null 2>&1 && exit
    exec >>"$docker_log" 2>&1
    made=$(mktemp -d)
    trap 'rm -rf "$made"' EXIT
    mkdir -p "$made/build/links"
    . /etc/os-release
    timeout 600 debootstrap --variant=minbase \
        --include=python3,python3-venv,ca-certificates "$VERSION_CODENAME" "$made/root" || exit
    tar -C "$made/root" -c . | docker import - udrl-ci-base || exit
    links=
    for folder in $(python3 -m pip config get global.find-links); do
        if [ -d "$folder" ]; then
            cp "$folder"/*.whl "$made/build/links" && links=/links || exit
        fi
    done
    cert=$(python3 -m pip config get global.cert || echo /etc/ssl/certs/ca-certificates.crt)
    cp "$cert" "$made/build/cert.pem" || exit
    printf '[global]\ncert = /cert.pem\nfind-links = %s\n' "$links" >"$made/build/pip.conf"
    printf '%s\n' 'FROM udrl-ci-base' 'COPY links /links' 'COPY cert.pem /cert.pem' \
        'COPY pip.conf /etc/pip.conf' >"$made/build/Dockerfile"
    docker build --tag udrl-ci-build "$made/build"
)

if engine; then
    docker image inspect python:3.11-slim-bookworm >/dev/null 2>&1 ||
        timeout 300 docker pull --quiet python:3.11-slim-bookworm >>"$docker_log" 2>&1 ||
        { images && export BASE_IMAGE=udrl-ci-base BUILD_IMAGE=udrl-ci-build; } ||
        NO_DOCKER="there is no base image; see $docker_log"
fi
