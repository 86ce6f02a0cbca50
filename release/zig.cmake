# A CMake toolchain for the platforms of release/wheels.py, whose compilers are Zig's. ETSPLAT_SYSTEM, ETSPLAT_PROCESSOR and
# ETSPLAT_TOOLS (a folder with c++, ar, ranlib and rc for that platform) are given with -D.
set(CMAKE_TRY_COMPILE_PLATFORM_VARIABLES ETSPLAT_SYSTEM ETSPLAT_PROCESSOR ETSPLAT_TOOLS)
set(CMAKE_SYSTEM_NAME "${ETSPLAT_SYSTEM}")
set(CMAKE_SYSTEM_PROCESSOR "${ETSPLAT_PROCESSOR}")
set(CMAKE_CXX_COMPILER "${ETSPLAT_TOOLS}/c++")
set(CMAKE_AR "${ETSPLAT_TOOLS}/ar")
set(CMAKE_RANLIB "${ETSPLAT_TOOLS}/ranlib")
set(CMAKE_RC_COMPILER "${ETSPLAT_TOOLS}/rc") # looked for on Windows, and not used
set(CMAKE_INSTALL_NAME_TOOL "${ETSPLAT_TOOLS}/none") # as on macOS
