//! Velodyne datagrams to calibrated revolutions.
//!
//! In: UDP payloads with the stamp of their arrival. Out: [`Revolution`]s in the sensor's frame (REP-103: x forward
//! at azimuth 0, y left, z up; metres). No socket, clock, thread or log: the same datagrams give the same revolutions.
//!
//! The files, in the order the data flows:
//!
//! | file | in -> out |
//! |---|---|
//! | [`capture`] | pcap or pcapng file -> UDP payloads |
//! | [`model`] | the sensors and their nominal figures |
//! | [`calibration`] | factory tables, ROS YAML, Velodyne XML -> per-laser corrections |
//! | [`packet`] | 1206 bytes -> [`packet::Packet`], or [`Refusal`] |
//! | [`telemetry`] | 512 bytes -> [`telemetry::Telemetry`] |
//! | [`time`] | device microseconds past the hour -> stamps |
//! | [`firing`] | packet -> firings |
//! | [`revolution`] | firings -> [`Revolution`] |
//! | [`sensor`] | all of the above behind one door: datagram in, revolution out |
