//! pcap and pcapng captures to UDP payloads.
//!
//! In: the bytes of a capture (Ethernet with or without VLAN tags, Linux cooked, raw IP, the loopback of BSD and
//! Windows). Out: [`Datagram`]s in file order. Packets that are not a complete UDP datagram are skipped and counted. A
//! file that ends inside a packet gives all datagrams before that packet, then an error with the position in the file.

use std::io::Read;
use std::net::{IpAddr, SocketAddr};

use etherparse::{EtherType, LaxNetSlice, LaxSlicedPacket, TransportSlice};
use pcap_parser::traits::PcapReaderIterator;
use pcap_parser::{Block, Linktype, PcapBlockOwned, PcapError};

/// Greatest length of a block, in bytes. The snapshot length of captures is 65,535 or 262,144, so no packet, and hence
/// no block, of a usable capture is longer.
const BLOCK_LENGTH_MAX: usize = 512 * 1024;
/// Number of bytes that are read before the format is known. The first block of a pcapng file must fit in; it contains
/// a few comments.
const HEAD_LENGTH: usize = 16 * 1024;
const NS_PER_SECOND: i128 = 1_000_000_000;

/// One UDP datagram of a capture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Time of capture, in ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Address and port of the sender.
    pub source: SocketAddr,
    /// Port of the receiver: 2368 for data, 8308 for telemetry in the factory settings.
    pub destination_port: u16,
    /// Payload of the UDP datagram, without headers.
    pub payload: Vec<u8>,
}

/// Numbers of packets of a capture that were skipped, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Skipped {
    /// Packets of other protocols, such as ARP or TCP.
    pub not_udp: u64,
    /// Fragments of datagrams.
    pub fragmented: u64,
    /// Packets that were cut off at capture or are damaged.
    pub unreadable: u64,
    /// Packets of a link type that is not read.
    pub link_type: u64,
    /// The first such link type: its number in the list of tcpdump.org.
    pub first_link_type: Option<i32>,
}

impl Skipped {
    /// A line for each reason, for people.
    pub fn notes(&self) -> Vec<String> {
        let link_type = self.first_link_type.map_or(String::new(), |link_type| {
            format!(
                "packets of link type {link_type} ignored; Ethernet, Linux cooked, raw IP and loopback are read: \
                 capture at the interface of the sensor"
            )
        });
        let all = [
            (self.not_udp, "packets that are not UDP ignored"),
            (self.fragmented, "pieces of fragmented datagrams ignored"),
            (self.unreadable, "unreadable packets ignored"),
            (self.link_type, &link_type),
        ];
        all.into_iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect()
    }
}

/// The reason for which a capture cannot be read, or not to its end.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CaptureError {
    /// The file is neither pcap nor pcapng.
    #[error("not a capture: it {}; pcap or pcapng is allowed", describe(start))]
    Format {
        /// At most the first four bytes of the file.
        start: Vec<u8>,
    },
    /// The file ends inside a packet.
    #[error("the capture is cut off inside the packet that starts at byte {offset}")]
    Truncated {
        /// Position in the file, in bytes from its start.
        offset: u64,
    },
    /// A block is invalid.
    #[error("the capture is damaged at byte {offset}: {what}")]
    Damaged {
        /// Position in the file, in bytes from its start.
        offset: u64,
        /// Description of the damage.
        what: String,
    },
    /// The file cannot be read.
    #[error("reading the capture at byte {offset}: {what}")]
    Read {
        /// Position in the file, in bytes from its start.
        offset: u64,
        /// Message of the operating system.
        what: String,
    },
}

/// How a file starts.
fn describe(start: &[u8]) -> String {
    if start.is_empty() { "is empty".into() } else { format!("starts with {start:02x?}") }
}

/// Reader of a capture: an iterator over its [`Datagram`]s that ends after the first error.
pub struct Capture<'a> {
    blocks: Box<dyn PcapReaderIterator + Send + 'a>,
    interfaces: Interfaces,
    is_pcapng: bool,
    skipped: Skipped,
    offset: u64,
    ended: bool,
}

impl<'a> Capture<'a> {
    /// Opens a capture.
    ///
    /// # Errors
    /// - [`CaptureError::Format`] if the file is neither pcap nor pcapng.
    /// - [`CaptureError::Truncated`] if the file ends inside its header.
    /// - [`CaptureError::Read`] if the reader fails.
    pub fn new(mut reader: impl Read + Send + 'a) -> Result<Self, CaptureError> {
        let read = |e: std::io::Error| CaptureError::Read { offset: 0, what: e.to_string() };
        let mut head = Vec::new();
        reader.by_ref().take(HEAD_LENGTH as u64).read_to_end(&mut head).map_err(read)?;
        let start = head[..head.len().min(4)].to_vec();
        let is_pcapng = start == [0x0A, 0x0D, 0x0D, 0x0A];
        let blocks = pcap_parser::create_reader(BLOCK_LENGTH_MAX, std::io::Cursor::new(head).chain(reader));
        let blocks = blocks.map_err(|error| match error {
            PcapError::Incomplete(_) if start.len() == 4 => CaptureError::Truncated { offset: 0 },
            PcapError::ReadError => CaptureError::Read { offset: 0, what: "a read failed".into() },
            _ => CaptureError::Format { start },
        })?;
        let (interfaces, skipped) = Default::default();
        Ok(Self { blocks, interfaces, is_pcapng, skipped, offset: 0, ended: false })
    }

    /// Packets that were skipped so far.
    pub fn skipped(&self) -> Skipped {
        self.skipped
    }

    /// Position behind the last packet that was read, in bytes from the start of the file.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Reads the next datagram; `None` if the file ends behind a complete packet.
    fn read(&mut self) -> Result<Option<Datagram>, CaptureError> {
        let offset = self.offset;
        loop {
            if self.is_pcapng && is_too_short(self.blocks.data()) {
                return Err(CaptureError::Damaged {
                    offset: self.offset,
                    what: "a block shorter than its head".into(),
                });
            }
            let (length, found) = match self.blocks.next() {
                Ok((length, block)) => (length, self.interfaces.apply(&block, &mut self.skipped)),
                Err(PcapError::Eof) => return Ok(None),
                Err(PcapError::Incomplete(_)) => {
                    refill(self.blocks.as_mut(), self.offset)?;
                    continue;
                }
                Err(PcapError::UnexpectedEof) => return Err(CaptureError::Truncated { offset: self.offset }),
                Err(error) => return Err(damaged(&error, self.offset)),
            };
            self.blocks.consume(length);
            self.offset += length as u64;
            if length == 0 {
                return Err(CaptureError::Damaged { offset, what: "a block of no length".into() });
            }
            if found.is_some() {
                return Ok(found);
            }
        }
    }
}

impl Iterator for Capture<'_> {
    type Item = Result<Datagram, CaptureError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let item = self.read().transpose();
        self.ended = !matches!(item, Some(Ok(_)));
        item
    }
}

/// True if the data begin with a process information block whose length field is less than the 12 bytes of every block.
/// pcap-parser would subtract 12 from that length. The block type is written in the byte order of the section.
fn is_too_short(block: &[u8]) -> bool {
    const LEAST: u32 = 12;
    match *block {
        [1, 0, 0, 0x80, a, b, c, d, ..] => u32::from_le_bytes([a, b, c, d]) < LEAST,
        [0x80, 0, 0, 1, a, b, c, d, ..] => u32::from_be_bytes([a, b, c, d]) < LEAST,
        _ => false,
    }
}

fn refill(blocks: &mut (dyn PcapReaderIterator + Send + '_), offset: u64) -> Result<(), CaptureError> {
    let before = blocks.data().len();
    let refilled = blocks.refill().is_ok();
    if !refilled {
        return Err(CaptureError::Read { offset, what: "a read failed".into() });
    }
    if blocks.data().len() == before && !blocks.reader_exhausted() {
        return Err(CaptureError::Damaged { offset, what: format!("a block longer than {BLOCK_LENGTH_MAX} bytes") });
    }
    if blocks.data().len() == before && blocks.reader_exhausted() && before > 0 {
        return Err(CaptureError::Truncated { offset });
    }
    Ok(())
}

fn damaged(error: &PcapError<&[u8]>, offset: u64) -> CaptureError {
    let what = match error {
        PcapError::BufferTooSmall => format!("a block longer than {BLOCK_LENGTH_MAX} bytes"),
        PcapError::NomError(_, kind) => format!("{kind:?}"),
        PcapError::OwnedNomError(_, kind) => format!("{kind:?}"),
        PcapError::ReadError => return CaptureError::Read { offset, what: "a read failed".into() },
        other => format!("{other:?}"),
    };
    CaptureError::Damaged { offset, what }
}

/// Properties of the capture's interfaces, from its headers.
#[derive(Default)]
struct Interfaces {
    list: Vec<Interface>,
}

#[derive(Clone, Copy)]
struct Interface {
    link: Linktype,
    ticks_per_second: u64,
    offset_s: i64,
}

impl Interfaces {
    /// Applies one block: a header changes the interfaces, a packet gives its datagram, if it contains one.
    fn apply(&mut self, block: &PcapBlockOwned<'_>, skipped: &mut Skipped) -> Option<Datagram> {
        match block {
            PcapBlockOwned::LegacyHeader(header) => {
                let ticks_per_second = if header.is_nanosecond_precision() { 1_000_000_000 } else { 1_000_000 };
                self.list = vec![Interface { link: header.network, ticks_per_second, offset_s: 0 }];
                None
            }
            PcapBlockOwned::Legacy(packet) => {
                let interface = *self.list.first()?;
                let ticks = u64::from(packet.ts_sec) * interface.ticks_per_second + u64::from(packet.ts_usec);
                interface.datagram(ticks, packet.data, skipped)
            }
            PcapBlockOwned::NG(block) => self.apply_ng(block, skipped),
        }
    }

    fn apply_ng(&mut self, block: &Block<'_>, skipped: &mut Skipped) -> Option<Datagram> {
        match block {
            Block::SectionHeader(_) => self.list.clear(),
            Block::InterfaceDescription(description) => self.list.push(Interface {
                link: description.linktype,
                ticks_per_second: ticks_per_second(description.if_tsresol),
                offset_s: description.if_tsoffset,
            }),
            Block::EnhancedPacket(packet) => {
                let ticks = u64::from(packet.ts_high) << 32 | u64::from(packet.ts_low);
                let data = packet.data.get(..packet.caplen as usize).unwrap_or(packet.data);
                let Some(interface) = self.list.get(packet.if_id as usize).copied() else {
                    skipped.unreadable += 1;
                    return None;
                };
                return interface.datagram(ticks, data, skipped);
            }
            // A simple packet block has no stamp.
            Block::SimplePacket(_) => skipped.unreadable += 1,
            _ => {}
        }
        None
    }
}

/// Ticks per second of a pcapng interface. `if_tsresol` is a negative power of ten, or of two if its highest bit is
/// set; a value too large for 64 bits is read as microseconds, the default of the format.
fn ticks_per_second(if_tsresol: u8) -> u64 {
    let (base, power) = if if_tsresol & 0x80 == 0 { (10_u64, if_tsresol) } else { (2, if_tsresol & 0x7F) };
    base.checked_pow(power.into()).unwrap_or(1_000_000)
}

/// `LINKTYPE_LINUX_SLL2`; pcap-parser has no name for it.
const LINUX_SLL2: Linktype = Linktype(276);

/// Slices a Linux cooked packet: its ethertype is at `ether_type`, its network header begins at `header`.
fn cooked(data: &[u8], ether_type: usize, header: usize) -> Option<LaxSlicedPacket<'_>> {
    let payload = data.get(header..)?;
    let ether_type = EtherType(u16::from_be_bytes([data[ether_type], data[ether_type + 1]]));
    Some(LaxSlicedPacket::from_ether_type(ether_type, payload))
}

impl Interface {
    fn datagram(self, ticks: u64, data: &[u8], skipped: &mut Skipped) -> Option<Datagram> {
        // The lax parser is needed because a VLP-16 sends telemetry with the IP length of its data packets.
        let sliced = match self.link {
            Linktype::ETHERNET => LaxSlicedPacket::from_ethernet(data).ok(),
            Linktype::LINUX_SLL => cooked(data, 14, 16),
            LINUX_SLL2 => cooked(data, 0, 20),
            // The family of the address, 4 bytes in the byte order of the host or of the network, then IP.
            Linktype::NULL | Linktype::LOOP => data.get(4..).and_then(|ip| LaxSlicedPacket::from_ip(ip).ok()),
            Linktype::RAW | Linktype::IPV4 | Linktype::IPV6 | Linktype(12 | 14) => LaxSlicedPacket::from_ip(data).ok(),
            Linktype(other) => {
                skipped.link_type += 1;
                skipped.first_link_type.get_or_insert(other);
                return None;
            }
        };
        let Some(sliced) = sliced else {
            skipped.unreadable += 1;
            return None;
        };
        let (address, fragmented) = match &sliced.net {
            Some(LaxNetSlice::Ipv4(ip)) => (IpAddr::V4(ip.header().source_addr()), ip.payload().fragmented),
            Some(LaxNetSlice::Ipv6(ip)) => (IpAddr::V6(ip.header().source_addr()), ip.payload().fragmented),
            _ => {
                skipped.not_udp += 1;
                return None;
            }
        };
        let Some(TransportSlice::Udp(udp)) = &sliced.transport else {
            *(if fragmented { &mut skipped.fragmented } else { &mut skipped.not_udp }) += 1;
            return None;
        };
        if usize::from(udp.length()) != udp.slice().len() {
            skipped.unreadable += 1;
            return None;
        }
        Some(Datagram {
            stamp_ns: self.stamp_ns(ticks),
            source: SocketAddr::new(address, udp.source_port()),
            destination_port: udp.destination_port(),
            payload: udp.payload().to_vec(),
        })
    }

    fn stamp_ns(self, ticks: u64) -> i64 {
        let ns = i128::from(ticks) * NS_PER_SECOND / i128::from(self.ticks_per_second);
        let ns = ns + i128::from(self.offset_s) * NS_PER_SECOND;
        i64::try_from(ns).unwrap_or(i64::MAX)
    }
}
