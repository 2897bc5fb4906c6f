//! Recordings: every event and every map of a run in one MCAP file.
//!
//! | file | in -> out |
//! |---|---|
//! | [`writer`] | events and maps -> queue -> recorder thread |
//! | [`mcap_file`] | events and maps -> bytes of the MCAP file |
//! | `mcap_records`, `chunk` | the bytes of any MCAP file -> its records, and the parts that cannot be read |
//! | `chunk_indexes` | the indexes behind a chunk -> whether a lost part was only some of them |
//! | `section_crc` | the bytes of a section -> whether any has changed |
//! | `bag_records` | a ROS 2 bag in sqlite -> the same records |
//! | `file_records` | a file of either kind -> its records |
//! | `header` | metadata and attachments -> what a recording says before its messages |
//! | `message_order` | events and maps -> whether they stand as they were written |
//! | `record_counts` | records -> how many there are, and how many there should be |
//! | `mcap_summary` | the end of an MCAP file -> its schemas and channels |
//! | [`channel`] | the topic, schema and encoding of a channel -> the kind of its messages |
//! | [`mcap_reader`] | those records -> the header and the messages |
//! | [`damage`] | a part that cannot be read -> what is lost with it |
//! | [`reader`] | those messages -> events, maps, ROS 2 messages |
//! | [`repair`] | damaged recording -> a whole one with all that can be read |
//! | [`verify`] | recording -> differences between the recorded maps and the maps of the recorded events |
//! | [`compare`] | two sets of maps of one drive -> changed cells, gained and lost free space |

#[cfg(feature = "sqlite")]
mod bag_records;
pub mod channel;
mod chunk;
mod chunk_indexes;
pub mod compare;
pub mod damage;
mod file_records;
mod header;
pub mod mcap_file;
pub mod mcap_reader;
mod mcap_records;
mod mcap_summary;
mod message_order;
pub mod reader;
mod record_counts;
pub mod repair;
mod section_crc;
pub mod verify;
pub mod writer;
