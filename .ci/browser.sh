# Sourced by .ci/run: installs Chromium if it is missing, on Debian as root.
#
# Sets NO_BROWSER to the reason if there is no Chromium afterwards.

browser() {
    command -v chromium >/dev/null && return
    NO_BROWSER="there is no Chromium"
    [ "$(id -u)" = 0 ] && grep -qx ID=debian /etc/os-release || return 1
    NO_BROWSER="Debian's chromium cannot be installed; see ${TMPDIR:-/tmp}/udrl-chromium.log"
    export DEBIAN_FRONTEND=noninteractive
    {
        timeout 600 apt-get -qq update && timeout 600 apt-get -qq install --no-install-recommends chromium
    } >"${TMPDIR:-/tmp}/udrl-chromium.log" 2>&1 || return 1
    unset NO_BROWSER
}

browser || true
