# Sourced by .ci/run: a Docker engine, if this machine can have one.
#
# Where none answers and this is Debian with root's rights, the distribution's packages give one. No image
# is pulled: the base is made of the distribution's own packages, and what pip needs here to reach a package
# index (certificates, folders of wheels) goes into the image that is only built in.
# Sets BASE_IMAGE, BUILD_IMAGE if it made them, ENGINE to the process that it started, and NO_DOCKER to
# the reason if there is no engine.

docker_log=${TMPDIR:-/tmp}/udrl-docker.log

engine() {
    docker info >/dev/null 2>&1 && return
    [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || { NO_DOCKER="no engine answers"; return 1; }
    NO_DOCKER="the engine cannot be installed; see $docker_log"
    export DEBIAN_FRONTEND=noninteractive
    timeout 600 apt-get -qq update >"$docker_log" 2>&1 || return 1
    timeout 600 apt-get -qq install --no-install-recommends docker.io docker-compose debootstrap iptables \
        >>"$docker_log" 2>&1 || return 1
    NO_DOCKER="the engine does not start; see $docker_log"
    setsid dockerd >>"$docker_log" 2>&1 &
    ENGINE=$!
    for _ in $(seq 60); do
        docker info >/dev/null 2>&1 && { unset NO_DOCKER; return; }
        sleep 1
    done
    return 1
}

images() {
    export BASE_IMAGE=udrl-ci-base BUILD_IMAGE=udrl-ci-build
    docker image inspect $BASE_IMAGE $BUILD_IMAGE >/dev/null 2>&1 && return
    local made; made=$(mktemp -d)
    timeout 600 debootstrap --variant=minbase \
        --include=python3,python3-venv,python3-pip,ca-certificates \
        "$(. /etc/os-release && echo "$VERSION_CODENAME")" "$made/root" >>"$docker_log" 2>&1
    tar -C "$made/root" -c . | docker import - $BASE_IMAGE >/dev/null
    mkdir -p "$made/build/links"
    local links=() folder cert
    for folder in $(python3 -m pip config get global.find-links 2>/dev/null); do
        [ -d "$folder" ] && cp "$folder"/*.whl "$made/build/links" && links=(/links)
    done
    cert=$(python3 -m pip config get global.cert 2>/dev/null || echo /etc/ssl/certs/ca-certificates.crt)
    cp "$cert" "$made/build/cert.pem"
    printf '[global]\ncert = /cert.pem\nfind-links = %s\n' "${links[@]}" >"$made/build/pip.conf"
    printf 'FROM %s\nCOPY links /links\nCOPY cert.pem /cert.pem\nCOPY pip.conf /etc/pip.conf\n' \
        $BASE_IMAGE >"$made/build/Dockerfile"
    docker build --quiet --tag $BUILD_IMAGE "$made/build" >>"$docker_log" 2>&1
    rm -rf "$made"
}

if engine; then
    # Without an image to build on, Compose tries to pull the default one.
    docker image inspect python:3.11-slim-bookworm >/dev/null 2>&1 ||
        timeout 300 docker pull --quiet python:3.11-slim-bookworm >>"$docker_log" 2>&1 || images
fi
