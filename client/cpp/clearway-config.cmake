# find_package(clearway 0.1 REQUIRED): clearway::clearway, maps and questions.
# find_package(clearway 0.1 REQUIRED COMPONENTS grpc): also clearway::grpc, the stream of maps.
include(CMakeFindDependencyMacro)
if("grpc" IN_LIST clearway_FIND_COMPONENTS)
    find_dependency(gRPC CONFIG)
    set(clearway_grpc_FOUND TRUE)
endif()
include("${CMAKE_CURRENT_LIST_DIR}/clearway-targets.cmake")
