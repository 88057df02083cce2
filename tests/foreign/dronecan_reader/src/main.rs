//! Reads DroneCAN frames, as ID#DATA a line, by the crate `dronecan`, and writes a line for each transfer that is whole:
//! kind, type, source, destination, whether its CRC is right, its payload. Of esc.Status its values follow.

use dronecan::{Id, Transfer};
use std::collections::HashMap;
use std::io::{self, BufRead};

fn signature(is_service: bool, number: u16) -> Option<u64> {
    Some(match (is_service, number) {
        (false, 341) => 0x0F0868D0C1A7C6F1,
        (false, 1034) => 0xA9AF28AEA2FBB254,
        (false, 1036) => 0x02DC203C50960EDC,
        (false, 1091) => 0x8313D33D0DDDA115,
        (false, 1110) => 0x70261C28A94144C6,
        (false, 16383) => 0xD654A48E0C049D75,
        (true, 1) => 0xEE468A8121C46A9E,
        (true, 11) => 0xA7B622F939D1A4D5,
        _ => return None,
    })
}

fn half(low: u8, high: u8) -> f64 {
    let bits = u16::from_le_bytes([low, high]);
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let exponent = (bits >> 10 & 31) as i32;
    let fraction = (bits & 1023) as f64;
    sign * match exponent {
        0 => fraction * 2f64.powi(-24),
        31 => return if fraction == 0.0 { sign * f64::INFINITY } else { f64::NAN },
        _ => (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    }
}

fn status(data: &[u8]) -> String {
    let errors = u32::from_le_bytes([data[0], data[1], data[2], data[3]]);
    let raw = (data[12] as i32 >> 6) << 16 | (data[11] as i32) << 8 | data[10] as i32;
    let rpm = if raw >= 1 << 17 { raw - (1 << 18) } else { raw };
    let percent = (data[12] & 0x3F) << 1 | data[13] >> 7;
    let index = data[13] >> 2 & 31;
    format!(
        " {} {} {} {} {} {} {}",
        errors, half(data[4], data[5]), half(data[6], data[7]), half(data[8], data[9]), rpm, percent, index
    )
}

fn main() {
    let mut transfers: HashMap<u32, Transfer> = HashMap::new();
    for line in io::stdin().lock().lines() {
        let line = line.unwrap();
        let (id, data) = line.split_once('#').unwrap();
        let raw = u32::from_str_radix(id, 16).unwrap();
        let data: Vec<u8> = (0..data.len() / 2)
            .map(|n| u8::from_str_radix(&data[2 * n..2 * n + 2], 16).unwrap())
            .collect();
        let (kind, number, source, to) = match Id::new(raw) {
            Id::Message { type_id, source_node, .. } => ("message", type_id, source_node, 0),
            Id::Service { service_type, source_node, destination_node, request, .. } => {
                (if request { "request" } else { "response" }, service_type as u16, source_node, destination_node)
            }
            Id::Anonymous { type_id, .. } => ("anonymous", type_id as u16, 0, 0),
        };
        let known = signature(kind.starts_with('r'), number);
        let transfer = transfers.entry(raw).or_insert_with(|| Transfer::new(vec![], known));
        match transfer.add_frame(&data) {
            Ok(Some(found)) => {
                let bytes: &[u8] = &found.data;
                let hex: String = bytes.iter().map(|byte| format!("{:02x}", byte)).collect();
                let more = if kind == "message" && number == 1034 { status(bytes) } else { String::new() };
                println!("{} {} {} {} {} {}{}", kind, number, source, to, found.crc_valid, hex, more);
            }
            Ok(None) => {}
            Err(error) => println!("error {} {}", id, error),
        }
    }
}
