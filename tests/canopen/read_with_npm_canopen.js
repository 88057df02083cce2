'use strict';
/* Prints as JSON what the npm package "canopen" reads from an EDS. node read_with_npm_canopen.js PACKAGE-FOLDER FILE

Its EDS reader is loaded by its file: the package as a whole wants a compiled CRC. */

const path = require('path');

const [folder, file] = process.argv.slice(2);
const { Eds } = require(path.join(folder, 'source', 'eds.js'));

const eds = Eds.fromFile(file);
const entries = [];

function tell(index, sub, entry) {
    entries.push({
        index,
        sub,
        name: entry.parameterName,
        type: entry.dataType,
        access: entry.accessType,
        mappable: Number(entry.pdoMapping || 0) !== 0,
        low: entry.lowLimit === undefined ? null : entry.lowLimit,
        high: entry.highLimit === undefined ? null : entry.highLimit,
        default: entry.defaultValue === undefined ? null : entry.defaultValue,
        value: entry.value === undefined ? null : entry.value,
    });
}

const names = {};
for (const entry of eds.values()) {
    names[entry.index] = entry.parameterName;
    if (entry.subNumber === undefined)
        tell(entry.index, 0, entry);
    else
        entry._subObjects.forEach((member, sub) => member && tell(entry.index, sub, member));
}

console.log(JSON.stringify({
    names,
    entries,
    bitRates: eds.baudRates,
    vendor: Number(eds.vendorNumber),
    product: Number(eds.productNumber),
    revision: Number(eds.revisionNumber),
    lss: eds.lssSupported,
    comments: Object.keys(eds.comments).length,
}, (_, value) => typeof value === 'bigint' ? Number(value) : value));
